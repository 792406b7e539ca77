"""How long calls take: the best of several, contestants in turns, so that noise hits all alike."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Hashable, Mapping
from typing import NamedTuple

# A contestant's turn lasts at least this long, s: cheap calls are repeated.
TURN = 0.05


class Cost(NamedTuple):
    """Seconds on the clock, and seconds of all cores together, child processes included."""

    wall: float
    cpu: float


def timed(call: Callable[[], object]) -> Cost:
    """Return what one call costs."""
    wall, cpu = time.perf_counter(), _cpu()
    call()
    return Cost(time.perf_counter() - wall, _cpu() - cpu)


def interleaved[Name: Hashable](
    contestants: Mapping[Name, Callable[[], object]], rounds: int
) -> dict[Name, Cost]:
    """Return the least cost of each contestant's call, over rounds in which all take a turn."""
    result: dict[Name, list[Cost]] = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, call in contestants.items():
            end = time.perf_counter() + TURN
            result[name].append(timed(call))
            while time.perf_counter() < end:
                result[name].append(timed(call))
    return {name: Cost(*map(min, zip(*costs, strict=True))) for name, costs in result.items()}


def _cpu() -> float:
    # The finer clock knows this process alone; children count once they have ended.
    times = os.times()
    return time.process_time() + times.children_user + times.children_system

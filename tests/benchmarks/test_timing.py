"""Contestants take turns, and what counts is the least of each."""

from __future__ import annotations

import time

from tests.benchmarks.timing import TURN, interleaved, timed


def test_contestants_take_turns() -> None:
    order: list[str] = []

    def of(name: str) -> None:
        order.append(name)
        time.sleep(TURN)

    interleaved({"a": lambda: of("a"), "b": lambda: of("b")}, 3)
    assert ["a", "b"] * 3 == order


def test_the_best_turn_counts() -> None:
    naps = iter([3 * TURN, TURN, 3 * TURN])
    cost = interleaved({"a": lambda: time.sleep(next(naps))}, 3)
    assert TURN <= cost["a"].wall < 2.9 * TURN


def test_sleep_costs_time_but_no_work() -> None:
    cost = timed(lambda: time.sleep(0.1))
    assert cost.wall >= 0.1
    assert cost.cpu < 0.05

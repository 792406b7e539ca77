"""How what takes its time tells how far it is: it calls a ``watch`` with the share that is done.

A share goes from 0 to 1 and never back. Who calls a function gives its steps their names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

# Called with the share that is done of one step; or with a step's name, and its share.
type Watch = Callable[[float], None]
type WatchSteps = Callable[[str, float], None]


def unwatched(*_: object) -> None:
    """Take note of nothing."""


def watched[T](items: Sequence[T], watch: Watch) -> Iterator[T]:
    """Yield items one by one, and call ``watch`` with the share of them that is done."""
    for number, item in enumerate(items, start=1):
        yield item
        watch(number / len(items))


def part(watch: Watch, first: float, last: float) -> Watch:
    """Return the watch of a part of a step, from one share of it to another."""
    return lambda share: watch(first + (last - first) * share)

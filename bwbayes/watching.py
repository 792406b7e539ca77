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
    more = counted(len(items), watch)
    for item in items:
        yield item
        more(1)


def counted(total: int, watch: Watch) -> Callable[[int], None]:
    """Return what is called with how many more of a total are done; ``watch`` gets the share."""
    done = 0
    watch(0.0 if total else 1.0)

    def more(count: int) -> None:
        nonlocal done
        done += count
        watch(min(done / total, 1.0))

    return more


def part(watch: Watch, first: float, last: float) -> Watch:
    """Return the watch of a part of a step, from one share of it to another."""
    return lambda share: watch(first + (last - first) * share)


def parts[T](items: Sequence[T], watch: Watch) -> Iterator[tuple[T, Watch]]:
    """Yield items, each with the watch of its equal part of a step."""
    for i, item in enumerate(items):
        yield item, part(watch, i / len(items), (i + 1) / len(items))

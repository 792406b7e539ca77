"""The page of a design: which signal teaches most, by how much, and what it looks like.

One HTML file that needs nothing else, as the report of a run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np

from bwbayes.app.report.page import Table, picture, template
from bwbayes.comparison.design import Asked, Promise

__all__ = ["render"]

# Standard errors of a difference below which two promises are not told apart.
SURE = 2.0

CAPTIONS = {
    "promises": (
        "What each candidate would leave",
        "The part that is expected to be left after one more record, with two Monte Carlo errors "
        "to either side; at 100 % a signal teaches nothing new.",
    ),
    "best": (
        "The best signal",
        "Its voltage, as best.csv has it for the signal generator; dotted, the amplifier's limits.",
    ),
}


def render(asked: Asked, made: Sequence[Promise], pictures: Mapping[str, bytes]) -> str:
    """Return the page; ``made`` is ranked, ``pictures`` are PNG files by their figure's name."""
    columns = ("Candidate", "Left", "Error", "Lowest", "Highest", "Fastest", "Length")
    return template("design.html.j2").render(
        run_standing=asked.standing,
        best=made[0],
        alike=alike(made),
        refused=[f"{one.name} {one.refused}" for one in made if one.refused],
        table=Table(
            "candidates",
            asked.left[0].upper() + asked.left[1:],
            columns,
            [_row(asked, one) for one in made],
            records=[asdict(one) for one in made],
            note="The error is that of Monte Carlo.",
        ),
        known=_facts(asked),
        pictures=[picture(png, name, *CAPTIONS[name]) for name, png in pictures.items()],
    )


def alike(made: Sequence[Promise]) -> list[str]:
    """Return the names of candidates that cannot be told apart from the best, the first."""
    best, *others = (one for one in made if not one.refused)
    return [
        one.name
        for one in others
        if one.left - best.left < SURE * float(np.hypot(one.error, best.error))
    ]


def _row(asked: Asked, one: Promise) -> tuple[str, ...]:
    voltage = asked.signals[one.name]
    fastest = float(np.max(np.abs(np.diff(voltage)))) / asked.interval
    known = ("–", "–") if one.refused else (f"{one.left:.1%}", f"{one.error:.1%}")
    return (
        one.name,
        *known,
        f"{voltage.min():.4g} V",
        f"{voltage.max():.4g} V",
        f"{fastest:,.0f} V/s",
        f"{asked.interval * voltage.size:.4g} s",
    )


def _facts(asked: Asked) -> list[tuple[str, str]]:
    amplifier = asked.amplifier
    limits = f"{amplifier.low:.4g} to {amplifier.high:.4g} V"
    if np.isfinite(amplifier.rate):
        limits += f", at most {amplifier.rate:.4g} V/s"
    return [
        ("Run", asked.run),
        ("To be known better", asked.left.replace(" left", "")),
        ("Amplifier", limits),
        ("Sampling interval", f"{asked.interval:g} s"),
    ]

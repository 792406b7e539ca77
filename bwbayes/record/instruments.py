"""Uncertainty of the instruments: of the scales of the sensor and of the voltage monitor.

A data sheet's sensitivity is a number with an uncertainty: ``'0.35 +- 0.004 um'`` or
``'0.35 um +- 1.2 %'``, a standard uncertainty. True displacement and true voltage are

    x = s y,   V = g u,   s ~ N(1, r_s²),   g ~ N(1, r_g²),

with the readings y and u. s and g are stages behind and before everything else. The likelihood,
in parameters in the scales of the readings, depends on neither: multiplying every um by s and every
V by g gives the same model. So the posterior of s and g is their prior, independent of all other
parameters, and sampling them gains nothing: each draw gets one s and one g, and its parameters are
multiplied by the powers of s and g that their units have, d in um/V by s / g, β in 1/V by 1 / g.
This is exact where the priors follow from the record's ranges; a stated prior or a fixed value
refers to the readings. A reading of the same sensor is predicted without s, which cancels.

The records of a fit share one sensor and one monitor. A sensor's linearity, the largest departure
of its curve from the straight line as a part of the range, is a smooth curve that the readings
cannot show either; its sd is that of a value between such limits, 1/√3 of it (JCGM 100, 4.3.7).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


class Scales(NamedTuple):
    """Ratios of true to read displacements and voltages, one for each draw, (draws,)."""

    sensor: FloatArray
    amplifier: FloatArray

    @classmethod
    def exact(cls, draws: int) -> Scales:
        """Return the ratios of exact instruments, all of them 1."""
        return cls(np.ones(draws), np.ones(draws))

    def factor(self, unit: str, exponent: float | FloatArray = 1.0) -> FloatArray:
        """Return the ratio of true to read numbers in a unit, such as ``um/V``, (draws,).

        ``exponent`` is the n of ``um^(1-n)/V``.
        """
        factor = np.ones_like(self.sensor)
        top, *below = unit.split("/")
        for term, sign in ((top, 1), *((term, -1) for term in below)):
            for token, power in re.findall(r"(?<!\w)(um|V)(?!\w)(?:\^(\(1-n\)|-?[\d.]+))?", term):
                degree = 1 - exponent if power == "(1-n)" else float(power or 1)
                factor *= (self.sensor if token == "um" else self.amplifier) ** (sign * degree)
        return factor


@dataclass(frozen=True)
class Instruments:
    """How well the instruments of a record are known.

    ``sensor_scale`` and ``amplifier_gain`` are the relative standard uncertainties of the sensor's
    and of the voltage monitor's scale; ``linearity`` is the sensor's largest departure from a
    straight line, as a part of the range.

    Raises InputError: one of them is negative or above a fifth.
    """

    sensor_scale: float = 0.0
    amplifier_gain: float = 0.0
    linearity: float = 0.0

    def __post_init__(self) -> None:
        # Beyond the largest uncertainty there is no calibration: a normal scale would reach zero.
        largest = 0.2
        for name, value in vars(self).items():
            if not 0 <= value <= largest:
                raise InputError(
                    f"{name.replace('_', ' ')}: an uncertainty of {100 * value:.3g} % is no "
                    f"calibration; give 0 to {100 * largest:g} %"
                )

    def updated(self, stated: Instruments) -> Instruments:
        """Return these instruments with the uncertainties that are stated, those above zero."""
        return replace(self, **{name: value for name, value in vars(stated).items() if value})

    def scales(self, draws: int, rng: np.random.Generator) -> Scales:
        """Draw scales by stratified sampling: each draw has its own part of the probability."""
        parts = (np.arange(draws) + 0.5) / draws
        scores = scipy.special.ndtri(np.stack([rng.permutation(parts) for _ in range(2)]))
        return Scales(1 + self.sensor_scale * scores[0], 1 + self.amplifier_gain * scores[1])

    def relative_sds(self, unit: str) -> tuple[float, float]:
        """Return the relative sds of a number in a unit, such as ``um/V``, by sensor and amplifier.

        The ``n`` of a unit is 1.
        """
        one, e = np.ones(1), np.full(1, np.e)
        powers = (float(np.log(Scales(*both).factor(unit)[0])) for both in ((e, one), (one, e)))
        sensor, amplifier = powers
        return abs(sensor) * self.sensor_scale, abs(amplifier) * self.amplifier_gain

    def linearity_sd(self, extent: float) -> float:
        """Return the sd, um, of the sensor's curve over a range of displacements, um."""
        return self.linearity * extent / math.sqrt(3)

    def displacements(
        self, draws: int, extent: float, rng: np.random.Generator
    ) -> Callable[[slice, FloatArray], FloatArray]:
        """Return a function from the readings of draws (draws, samples) to displacements, um.

        With φ = 2π y / E over the ``extent`` E, um, of the fitted readings, the sensor's curve is
        σ (a sin φ + b cos φ), a and b standard normal: its sd is that of the linearity everywhere.
        """
        scale, sd = self.scales(draws, rng).sensor[:, np.newaxis], self.linearity_sd(extent)
        a, b = sd * rng.standard_normal((2, draws, 1))

        def true(rows: slice, read: FloatArray) -> FloatArray:
            moved: FloatArray = scale[rows] * read
            if sd:
                phase = 2 * np.pi * read / extent
                moved += a[rows] * np.sin(phase) + b[rows] * np.cos(phase)
            return moved

        return true

    @property
    def facts(self) -> dict[str, str]:
        """The stated uncertainties in words, by subject."""
        known = "known to {:.3g} % (one standard uncertainty)"
        named = {
            "sensor scale": (self.sensor_scale, known),
            "monitor scale": (self.amplifier_gain, known),
            "sensor linearity": (self.linearity, "within {:.3g} % of the range"),
        }
        return {name: text.format(100 * value) for name, (value, text) in named.items() if value}


# Instruments without stated uncertainties.
EXACT = Instruments()


def split_uncertainty(unit: str, where: str) -> tuple[str, float | None]:
    """Return a unit without its uncertainty, and the relative uncertainty, or None without one.

    Raises InputError: an uncertainty that cannot be read.
    """
    sign = r"\s*(?:\+-|\+/-|±)\s*"
    if not re.search(sign, unit):
        return unit, None
    if match := re.fullmatch(rf"(.*?\S){sign}({_NUMBER})\s*%", unit.strip()):
        return match[1], float(match[2]) / 100
    match = re.fullmatch(rf"(-?{_NUMBER}){sign}({_NUMBER})\s*(\D.*)", unit.strip())
    if match is None or float(match[1]) == 0:
        raise InputError(
            f"{where}: cannot read {unit!r}; write '0.35 +- 0.004 um' or '0.35 um +- 1.2 %'"
        )
    return f"{match[1]} {match[3]}", float(match[2]) / abs(float(match[1]))


def part_of_range(text: str, where: str) -> float:
    """Return the part of a range that a text such as ``0.1 %`` states.

    Raises InputError: it is no percentage.
    """
    match = re.fullmatch(rf"\s*({_NUMBER})\s*%\s*", text)
    if match is None:
        raise InputError(f"{where}: {text!r} is no part of the range; write '0.1 %'")
    return float(match[1]) / 100

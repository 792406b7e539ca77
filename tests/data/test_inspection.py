"""What is wrong with a record is named, and nothing is said about a good one."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.data import Record
from bwbayes.data.inspection import Finding, inspect


def findings(kind: str, voltage: FloatArray, displacement: FloatArray) -> list[Finding]:
    return [one for one in inspect(Record(voltage, displacement, 1e-3)) if one.kind == kind]


SINE = np.sin(np.linspace(0.0, 12 * np.pi, 3000))


@pytest.mark.parametrize("limits", [(-0.8, 2.0), (-2.0, 0.8)])
@pytest.mark.parametrize("step", [1e-6, 0.01])
def test_a_displacement_cut_off_at_its_limit_is_clipping(
    limits: tuple[float, float], step: float
) -> None:
    clipped = np.clip(np.round(SINE / step) * step, *limits)
    (finding,) = findings("clipping", SINE, clipped)
    inside = slice(round(finding.start / 1e-3), round(finding.stop / 1e-3))
    assert 1 == np.unique(clipped[inside]).size
    assert "exclude = [[" in finding.remedy


TRAPEZOID = np.clip(SINE, -0.7, 0.7)
SQUARE = np.sign(SINE + 1e-9)


@pytest.mark.parametrize("step", [0.3, 0.1, 0.03, 0.01, 0.001])
@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.99])
@pytest.mark.parametrize(
    ("voltage", "lag"),
    [(SINE, 0), (SINE, 40), (SINE, 125), (TRAPEZOID, 0), (TRAPEZOID, 20), (SQUARE, 1)],
    ids=["sine", "lagging sine", "sine a quarter late", "plateaus", "late plateaus", "late steps"],
)
def test_a_coarse_sensor_alone_is_not_taken_for_a_clipped_one(
    step: float, shift: float, voltage: FloatArray, lag: int
) -> None:
    """Not at smooth peaks, whatever the phase, and not at rest on the highest plateau."""
    coarse = np.round(np.roll(voltage, lag) / step + shift) * step
    assert [] == findings("clipping", voltage, coarse)

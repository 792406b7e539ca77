"""What a run's files hold is what was computed, to the digits that matter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.prediction.bands import Bands
from bwbayes.report.outputs import write_bands
from tests.app.example import bands


def moved(one: Bands, offset: float, factor: float) -> Bands:
    """Return bands of a displacement in other proportions, one reading of which is missing."""

    def change(values: FloatArray) -> FloatArray:
        return factor * values + offset

    assert one.measured is not None
    measured = change(one.measured)
    measured[7] = np.nan
    return replace(
        one,
        mean=change(one.mean),
        measured=measured,
        lower={key: change(edge) for key, edge in one.lower.items()},
        upper={key: change(edge) for key, edge in one.upper.items()},
    )


@pytest.mark.parametrize(
    ("offset", "factor"), [(0.0, 1.0), (12_345.6, 0.01), (-9e7, 1e-3), (5.0, 0.0)]
)
def test_bands_have_the_digits_of_their_range(tmp_path: Path, offset: float, factor: float) -> None:
    """A sensor that reads 12,345.6 um while the displacement moves by 1.2 um."""
    made = moved(bands(samples=400, lead_in=10), offset, factor)
    write_bands(tmp_path / "bands.csv", [made])
    table = np.genfromtxt(tmp_path / "bands.csv", delimiter=",", names=True)
    for name, column in made.columns():
        span = np.nanmax(column) - np.nanmin(column)
        atol = max(1e-6 * span, 1e-7 * abs(offset) * (span == 0), 1e-15 * abs(offset))
        np.testing.assert_allclose(table[name], column, rtol=0, atol=atol, err_msg=name)

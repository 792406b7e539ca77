"""Roots along one stretch, against the curve that they belong to."""

from __future__ import annotations

import numpy as np
import pytest

from bwbayes.model.inverse.stretch import reached


@pytest.mark.parametrize("s", [1.0, -1.0])
def test_a_search_finds_all_samples_of_a_path_at_once(s: float) -> None:
    """A cubic, with targets that begin at the start and end beyond the edge."""

    def curve(u: np.ndarray) -> np.ndarray:
        assert (s * np.diff(u) >= 0).all()  # as a path is walked
        return u + 0.1 * u**3

    known = 2.0 + s * np.linspace(0.0, 3.0, 50)
    computed = reached(curve, curve(known), 2.0, 2.0 + 9 * s, 0.1)
    np.testing.assert_allclose(computed, known, atol=1e-13)
    short = reached(curve, curve(known), 2.0, 2.0 + 2 * s, 0.1)
    np.testing.assert_allclose(short, 2.0 + np.clip(s * (known - 2.0), 0.0, 2.0) * s, atol=1e-13)

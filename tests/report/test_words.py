"""Numbers as texts: with the digits that tell something, at any size."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bwbayes.report.words import length_text


@given(st.floats(1e-9, 1e5))
def test_a_length_keeps_three_digits_at_any_size(um: float) -> None:
    text = length_text(um)
    assert text.endswith(" µm")
    np.testing.assert_allclose(float(text[:-3]), um, rtol=0.0051)

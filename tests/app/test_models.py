"""Models in a line are what a config would say of them, and what cannot be read is one line."""

from __future__ import annotations

import pytest

from bwbayes.app.config.keywords import models_of
from bwbayes.app.config.settings import ModelConfig
from bwbayes.errors import InputError

BASE = ModelConfig(gain=["cubic"], creep=True, dynamics="none", hold="first", passive=False)


def test_what_is_said_is_taken_and_the_rest_is_the_configs() -> None:
    text = "bouc-wen; maxwell-slip(thresholds=4)+quadratic +cubic; linear + creep + lag + white;"
    models = models_of(text, BASE)
    assert list(models) == [
        "bouc-wen",
        "maxwell-slip(thresholds=4) + quadratic + cubic",
        "linear + creep + lag + white",
    ]
    first, second, third = models.values()
    assert first == ModelConfig(dynamics="none", hold="first")
    assert (second.hysteresis, second.thresholds) == ("maxwell-slip", 4)
    assert second.gain == ["quadratic", "cubic"]
    assert (third.creep, third.dynamics, third.noise) == (True, "lag", "white")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("bouc-wenn", "did you mean bouc-wen?"),
        ("bouc-wen + quadratik", "did you mean quadratic?"),
        ("plays(treshold=4)", "treshold is unknown"),
        ("plays(thresholds=)", "write options as in thresholds=4"),
        ("plays(thresholds='x')", "thresholds"),
        ("bouc-wen; bouc-wen", "is there twice"),
        (" ; ", "names no model"),
        ("+ quadratic", "begin with an operator"),
    ],
)
def test_what_cannot_be_read_is_refused_in_a_line(text: str, said: str) -> None:
    with pytest.raises(InputError, match="models: ") as refused:
        models_of(text, BASE)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)

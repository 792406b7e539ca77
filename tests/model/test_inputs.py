"""What drives an actuator, cut and put together on one clock."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.errors import InputError
from bwbayes.model.inputs import Inputs
from bwbayes.record import Record

INTERVAL = 0.25


def inputs_of(samples: int) -> Inputs:
    voltage = np.random.default_rng(samples).normal(size=samples)
    covariates = {"temperature_degC": 20 + voltage**2, "load_N": -voltage}
    return Inputs(voltage, interval=INTERVAL, start=-3.0, covariates=covariates)


def record_of(samples: int) -> Record:
    inputs = inputs_of(samples)
    return Record(displacement=2 * inputs.voltage, truth=3 * inputs.voltage, **vars(inputs))


@given(samples=st.integers(2, 60), data=st.data())
def test_parts_put_together_are_the_whole(samples: int, data: st.DataObject) -> None:
    """Of inputs and of a record: every series, cut at any sample."""
    cut = data.draw(st.integers(1, samples - 1))
    for whole in (inputs_of(samples), record_of(samples)):
        again = whole[:cut].followed_by(whole[cut:])
        for name, value in vars(whole).items():
            np.testing.assert_equal(getattr(again, name), value)


@given(
    samples=st.integers(2, 60),
    first=st.integers(0, 40),
    last=st.integers(1, 60),
    step=st.integers(1, 5),
)
def test_samples_keep_their_times(samples: int, first: int, last: int, step: int) -> None:
    whole, part = inputs_of(samples), slice(first, last, step)
    cut = whole[part]
    np.testing.assert_allclose(cut.time, whole.time[part], atol=1e-12)
    for name in ("voltage", *whole.covariates):
        np.testing.assert_array_equal(cut.column(name), whole.column(name)[part])


def test_what_is_not_known_is_refused() -> None:
    whole = inputs_of(10)
    with pytest.raises(InputError, match="pressure: the model needs it at every sample"):
        whole.column("pressure")
    with pytest.raises(InputError, match="temperature_degC: the model needs it at every sample"):
        whole.followed_by(Inputs(whole.voltage, interval=INTERVAL))


def test_a_record_is_driven_on_a_clock_that_starts_with_it() -> None:
    record = record_of(40)
    assert record.start == -3.0
    assert record.inputs.time[0] == 0.0
    assert record.inputs.hold == "first"
    assert Record(record.voltage, None, interval=1.0, voltage_is="command").inputs.hold == "zero"
    np.testing.assert_array_equal(record.inputs.column("load_N"), -record.voltage)


def test_a_record_with_other_covariates_is_another_one() -> None:
    record = record_of(40)
    without = Record(record.voltage, record.displacement, interval=INTERVAL, start=-3.0)
    other = Record(
        record.voltage,
        record.displacement,
        interval=INTERVAL,
        start=-3.0,
        covariates={"load_N": record.voltage, "temperature_degC": record.voltage},
    )
    assert len({record.sha256, without.sha256, other.sha256}) == 3


@pytest.mark.parametrize("wrong", [np.zeros(9), np.full(10, np.nan), np.zeros((10, 1))])
def test_a_covariate_is_known_at_every_sample(wrong: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"^load_N: "):
        Record(np.arange(10.0), None, interval=1.0, covariates={"load_N": wrong})

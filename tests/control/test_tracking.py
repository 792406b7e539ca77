"""What tracking promises: with feed-forward, PID control follows better than with either alone."""

import numpy as np
import pytest

from bwbayes.arrays import FloatArray
from bwbayes.control.loop import CONTROLLERS, LoopNoise, Stand
from bwbayes.control.references import TRACKED, tracking_signals
from bwbayes.control.tracking import Tracking, track
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Limits
from tests.control import cases

# As the ring bender's posterior has them; d and α go together, so that the loop keeps its size.
SDS = {"beta": 0.0012, "gamma": 0.0027, "damping": 350.0}
NAME = "bouc-wen, second-order"


def draws(count: int) -> tuple[Actuator, FloatArray, LoopNoise]:
    """Return draws about Table 1 of the paper, as a posterior of the virtual stand has them."""
    actuator, generator = cases.actuator(NAME, "zero"), np.random.default_rng(11)
    theta = np.tile(cases.theta(actuator), (count, 1))
    for name, sd in SDS.items():
        theta[:, actuator.parameters.index(name)] += sd * generator.standard_normal(count)
    both = generator.standard_normal(count)
    theta[:, actuator.parameters.index("d")] += 0.0048 * both
    theta[:, actuator.parameters.index("alpha")] += 0.0122 * both
    return actuator, theta, cases.noise_of(count, 0.5, 1.5, 0.5)


@pytest.fixture(scope="module")
def tracking() -> Tracking:
    rng = np.random.default_rng(2)
    return track(*draws(40), Stand(Limits(*cases.SPAN)), rng, frequencies=(2.0, 10.0, 20.0))


def test_feed_forward_and_feedback_together_beat_either_alone(tracking: Tracking) -> None:
    """At every frequency up to 20 Hz, on all signals, for at least 95% of the draws."""
    assert (3, 4) == tracking.best.shape
    assert (tracking.best >= 0.95).all(), tracking.best


def test_the_table_says_what_the_arrays_say(tracking: Tracking) -> None:
    frame = tracking.to_pandas()
    assert len(CONTROLLERS) * len(TRACKED) * 3 == len(frame)
    row = frame.query("signal == 'steps' and frequency_Hz == 10 and controller == 'PID'").iloc[0]
    errors = tracking.rms[2, 1, tracking.signals.index("steps")]
    assert errors.mean() == row["rms_um"]
    assert (np.quantile(errors, 0.025), np.quantile(errors, 0.975)) == pytest.approx(
        (row["rms_um_low"], row["rms_um_high"])
    )
    numbers = tracking.numbers()
    assert numbers["robustness"]["stable"]
    assert numbers["robustness"]["gain_margin_least"] >= 2
    assert numbers["robustness"]["phase_margin_least_deg"] >= 60
    assert frame.to_dict("records") == numbers["table"]


def test_by_default_it_goes_to_where_the_dynamics_matter() -> None:
    """Half of a sine's power is left at 41 Hz: from 0.1 Hz to the next of 1, 2 and 5."""
    actuator, theta, noise = draws(2)
    # Short, because a lag of the same cut-off is sampled ten times as slowly.
    slow = cases.actuator(NAME, "zero", 1e-2)
    theta[:, actuator.parameters.index("damping")] *= 10
    made = track(
        slow, theta, noise, Stand(Limits(*cases.SPAN)), np.random.default_rng(2), amplitude=1e-3
    )
    assert (0.1, 0.2, 0.5, 1.0, 2.0, 5.0) == made.frequencies
    assert 4 * 0.0385 == pytest.approx(made.rise, rel=0.1)


def test_a_range_on_one_side_of_zero_is_approached_first() -> None:
    actuator, theta, noise = draws(4)
    noise = cases.noise_of(4, 0.0, 0.0, 0.5)
    same = np.tile(theta.mean(axis=0), (4, 1))
    stand = Stand(Limits(0.0, 100.0))
    made = track(actuator, same, noise, stand, np.random.default_rng(2), frequencies=(5.0,))
    assert made.middle - made.amplitude > 0
    # The right model, but for the DAC's steps of 0.1 V: 0.02 um rms, at the most 0.07 um.
    sine = made.signals.index("sine")
    assert made.rms[1, 0, sine].max() < 0.03
    assert made.largest[1, 0, sine].max() < 0.1


@pytest.mark.parametrize("frequency", [0.5, 20.0])
def test_references_swing_by_their_amplitude_and_jump_in_time(frequency: float) -> None:
    signals, begins = tracking_signals(frequency, 1e-3, 30.0, 10.0, rise=8)
    assert 1000 == begins
    assert np.abs(np.diff(signals[:, :begins])).max() < 0.05
    swung = signals[:, begins:] - 30.0
    np.testing.assert_allclose(np.abs(swung).max(axis=1)[[0, 2]], 10.0, rtol=5e-3)
    assert (np.abs(swung) <= 10 + 1e-9).all()
    jumps = np.flatnonzero(np.diff(swung[list(TRACKED).index("steps")]) != 0)
    # A jump takes its samples, and no more.
    starts = np.flatnonzero(np.diff(jumps, prepend=-9) > 1)
    assert (np.diff(np.append(starts, jumps.size)) <= 8).all()
    assert 0 == tracking_signals(frequency, 1e-3, 0.0, 10.0)[1]


def test_a_tracking_of_no_frequency_is_refused() -> None:
    with pytest.raises(InputError, match="frequencies: none is given"):
        track(*draws(3), Stand(Limits(*cases.SPAN)), np.random.default_rng(2), frequencies=())

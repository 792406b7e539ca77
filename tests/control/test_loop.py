"""The closed loop: slow twins, amplifier and margins, and that feed-forward with feedback is best.

Margins are those of textbooks and of closed-loop poles; a design keeps them with every draw.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import bwbayes as bw
from bwbayes.arrays import FloatArray
from bwbayes.control.loop import (
    ANGLES,
    CONTROLLERS,
    Gains,
    LoopNoise,
    LoopPlan,
    Margins,
    OpenLoop,
    Robustness,
    Stand,
    design,
    follow,
)
from bwbayes.control.references import TRACKED, tracking_signals
from bwbayes.control.sampled import SampledModel
from bwbayes.control.tracking import Tracking, track
from bwbayes.errors import InputError
from bwbayes.inference.noise import DiscrepancyNoise, SmoothNoise, WhiteNoise
from bwbayes.inference.state_space import Noise
from bwbayes.inference.study import generator
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Limits, Span
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.record.teststand import PROCESS_SD, PROCESS_TIME
from tests.control import cases
from tests.control.cases import noise_of
from tests.measured import keep

QUIET = noise_of(2, 0.0, 0.0, 1.0)


def of(name: str, count: int, copies: int) -> tuple[Actuator, FloatArray, SampledModel]:
    actuator = cases.actuator(name, "zero")
    theta = cases.theta(actuator, count, name)
    return actuator, theta, SampledModel.of(actuator, np.tile(theta, (copies, 1)))


def references(samples: int = 81) -> FloatArray:
    time = 1e-3 * np.arange(samples)
    return np.stack([40 * np.sin(2 * np.pi * 12 * time), np.where(time < 0.05, 30.0, -20.0)])


def slowly(
    actuator: Actuator, theta: FloatArray, plan: LoopPlan, gains: Gains, stand: Stand
) -> tuple[FloatArray, FloatArray]:
    """Return rms and largest error, simulating the whole past at every sample."""
    controllers, signals, samples = plan.ahead.shape
    shape = controllers, signals, len(theta)
    rms, largest = np.empty(shape), np.empty(shape)
    for c, s, m in np.ndindex(shape):
        held: list[float] = []
        missed: list[float] = []
        answers, errors = [0.0] * stand.delay, [0.0, 0.0]
        answer = 0.0
        for t in range(samples - 1):
            # Held voltages act a sample later, so the present one may be anything.
            voltage = np.array([0.0, *held, 0.0])
            x = actuator.displacement(theta[m : m + 1], voltage, from_rest=True)[0, -1]
            missed.append(x - plan.reference[s, t])
            reading = stand.sensor.step * np.round(x / stand.sensor.step)
            errors.append(plan.targets[c, s, t] - reading)
            if plan.looks[c]:
                answer += sum(q * e for q, e in zip(gains.steps, errors[:-4:-1], strict=True))
                later = plan.ahead[c, s, t + stand.delay] if t + stand.delay < samples else 0.0
                answer = min(max(answer, stand.limits.low - later), stand.limits.high - later)
            answers.append(answer)
            command = plan.ahead[c, s, t] + answers.pop(0)
            level = stand.amplifier.step * np.round(command / stand.amplifier.step)
            level = min(max(level, stand.limits.low), stand.limits.high)
            reach, last = stand.allowed.rate * 1e-3, held[-1] if held else 0.0
            held.append(min(max(level, last - reach), last + reach))
        judged = np.array(missed[plan.begins :])
        rms[c, s, m] = np.sqrt(np.mean(judged**2))
        largest[c, s, m] = np.abs(judged).max()
    return rms, largest


@pytest.mark.parametrize("name", ["bouc-wen, second-order", "plays, lag, nonlinearity"])
@pytest.mark.parametrize("delay", [0, 1, 2])
def test_the_loop_is_the_slow_one(name: str, delay: int) -> None:
    actuator, theta, rows = of(name, 2, 6)
    required = references()
    ahead = np.stack([required / 0.6, np.zeros_like(required), required / 0.6])
    # So near that it is met: then the answers are kept to what is still to be had.
    stand = Stand(Limits(-55.0, 45.0, current=0.02, capacitance=1e-6), delay)
    plan = LoopPlan(
        np.clip(ahead, -55, 45),
        np.stack([0 * required, required, required]),
        (False, True, True),
        required,
        10,
    )
    gains = Gains((1.2, -0.9, 0.02), 1e-3)
    got_rms, got_largest, limited = follow(
        plan, gains, rows, QUIET, stand, np.random.default_rng(1)
    )
    rms, largest = slowly(actuator, theta, plan, gains, stand)
    np.testing.assert_allclose(got_rms, rms, rtol=1e-9)
    np.testing.assert_allclose(got_largest, largest, rtol=1e-9)
    assert (limited > 0).any()


def test_without_feedback_it_is_the_virtual_stands_amplifier_and_actuator() -> None:
    actuator, theta, rows = of("bouc-wen with all", 2, 2)
    required = references(400)
    command = np.clip(required / 0.5, -80, 80)
    command[:, 0] = 0.0
    stand = Stand(Limits(-100.0, 100.0))
    plan = LoopPlan(command[np.newaxis], required[np.newaxis], (False,), required, 0)
    gains = Gains((1.0, 0.0, 0.0), 1e-3)
    got_rms, _, _ = follow(plan, gains, rows, QUIET, stand, np.random.default_rng(1))
    for s in range(2):
        output = stand.amplifier.output(command[s], 1e-3)
        x = actuator.displacement(theta, output, from_rest=True)[:, :-1]
        rms = np.sqrt(np.mean((x - required[s, :-1]) ** 2, axis=1))
        np.testing.assert_allclose(got_rms[0, s], rms, rtol=1e-9)


def test_a_discrepancy_is_an_error_and_sensor_noise_is_none() -> None:
    """At rest: the rms error is that of the process, 400 draws of 100 of its times.

    Within five standard errors of the mean square, which for an Ornstein-Uhlenbeck process over
    N times is sd² sqrt(2 / N): of 40,000 times 0.7% each, so a false alarm once in a million, and
    a process with a wrong time or sd 4% off is noticed. Sensor noise alone leaves none.
    """
    _, _, rows = of("bouc-wen", 1, 400)
    required = np.zeros((1, 1001))
    plan = LoopPlan(np.zeros((1, 1, 1001)), np.zeros((1, 1, 1001)), (False,), required, 0)
    noise = noise_of(400, 0.5, 1.5, 0.01)
    gains, stand = Gains((0.1, 0.0, 0.0), 1e-3), Stand(Limits(*cases.SPAN))
    rms, _, _ = follow(plan, gains, rows, noise, stand, np.random.default_rng(8))
    spread = 1.5**2 * np.sqrt(2 / 40_000)
    assert np.mean(rms**2) == pytest.approx(1.5**2, abs=5 * spread)
    alone = noise_of(400, 0.5, 0.0, 0.01)
    _, largest, _ = follow(plan, gains, rows, alone, stand, np.random.default_rng(8))
    assert 0 == largest.max()


@pytest.mark.parametrize(
    ("model", "theta"),
    [
        (WhiteNoise(), (0.5,)),
        (DiscrepancyNoise(), (0.5, 1.5, 0.05)),
        (SmoothNoise(), (0.5, 1.5, 0.05, 2.0)),
    ],
)
def test_a_loop_has_the_noise_model_of_the_fit(model: Noise, theta: tuple[float, ...]) -> None:
    """Covariances of 20,000 draws six samples on, within five standard errors."""
    every = np.tile(theta, (20_000, 1))
    walk = LoopNoise(model, every).walk(0.01, np.random.default_rng(3))
    discrepancy, sensor = np.stack([next(walk) for _ in range(6)], axis=1)
    sds = model.marginal_sd(every[:1])
    kept = np.zeros(6)
    if model.states:
        kept = model.at(0.01).transition(every[:1], np.arange(6.0))[0, :, 0, 0]
    for values, sd, shared in ((discrepancy, sds[0], kept), (sensor, sds[1], np.eye(6)[0])):
        got = values @ values[0] / len(every)
        np.testing.assert_allclose(got, sd**2 * shared, atol=5 * sd[0] ** 2 * (2 / 20_000) ** 0.5)


def test_out_of_reach_for_long_it_comes_back_at_once() -> None:
    """Without anti-windup an integrator would have a second's errors to take back."""
    actuator, theta, rows = of("bouc-wen, second-order", 2, 1)
    limits = Span(-50.0, 50.0)
    one = SampledModel.of(actuator, theta)
    gains, _ = design(one, one, limits, 1, Robustness())
    required = np.concatenate([np.full(1000, 200.0), np.zeros(201)])[np.newaxis]

    def error(begins: int) -> float:
        plan = LoopPlan(np.zeros((1, 1, 1201)), required[np.newaxis], (True,), required, begins)
        stand, generator = Stand(Limits(*limits)), np.random.default_rng(1)
        _, largest, _ = follow(plan, gains, rows, QUIET, stand, generator)
        return float(largest.max())

    assert 100 < error(900)
    # Sixty samples after the reference is back: a DAC's step is 0.07 um.
    assert error(1060) < 0.2


QUICK = {"bouc-wen", "bouc-wen, second-order", "plays, lag, nonlinearity"}
every_actuator = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in cases.ACTUATORS
    ],
)


def models(name: str, count: int = 20, interval: float = 1e-3) -> SampledModel:
    actuator = cases.actuator(name, "zero", interval)
    return SampledModel.of(actuator, cases.theta(actuator, count, name))


def without_hysteresis(slope: float) -> SampledModel:
    actuator = Actuator("none", "zero", 1e-3, BoucWen())
    values = {"d": slope, "alpha": 1e-12 * slope, "beta": 1.0, "exponent": 1.0}
    return SampledModel.of(
        actuator, np.array([[values.get(one, 0.0) for one in actuator.parameters]])
    )


def largest_pole(gains: Gains, draws: SampledModel) -> float:
    """Return the largest pole of the closed loop at the steepest slope, with a sample's delay."""
    numerator, denominator, gain = (values[0, 0] for values in draws.sections)
    opened = np.convolve(denominator, [1.0, -1.0])
    slope = draws.slopes(cases.SPAN)[1][0]
    fed = np.append(0.0, slope * gain * np.convolve(numerator, gains.steps))
    return float(np.abs(np.roots(fed + np.pad(opened, (0, fed.size - opened.size)))).max())


def margins_of(gains: Gains, draws: SampledModel, delay: int) -> Margins:
    loop = OpenLoop(gains, draws.frequency_response(ANGLES), delay)
    return loop.margins(draws.slopes(cases.SPAN))


def scaled(gains: Gains, factor: float) -> Gains:
    first, second, third = (factor * one for one in gains.steps)
    return replace(gains, steps=(first, second, third))


@settings(max_examples=15)
@given(speed=st.floats(0.01, 0.4), slope=st.floats(0.1, 10.0), delay=st.integers(0, 4))
def test_margins_of_an_integrator_are_the_closed_form(
    speed: float, slope: float, delay: int
) -> None:
    """L = K z^−(1+D) / (1 − 1/z): |L| = K / (2 sin(θ/2)), its lag is π/2 + (D + 1/2) θ."""
    made = without_hysteresis(slope)
    result = margins_of(Gains((speed / slope, 0.0, 0.0), 1e-3), made, delay)
    crossing = 2 * np.arcsin(speed / 2)
    gain = 2 * np.sin(np.pi / (2 * (2 * delay + 1))) / speed
    assert result.gain[0] == pytest.approx(gain, rel=1e-3)
    assert result.phase[0] == pytest.approx(90 - np.degrees((delay + 0.5) * crossing), abs=0.02)
    assert result.crossover[0] == pytest.approx(crossing / (2 * np.pi * 1e-3), rel=0.02)
    assert bool(gain > 1) == result.stable or not result.circle[0] > 0


@pytest.mark.parametrize("name", sorted(QUICK))
def test_at_its_gain_margin_a_loop_has_a_pole_on_the_circle(name: str) -> None:
    """The margin comes from the frequency response; poles are worked out apart, and agree."""
    draws = models(name)
    gains = design(draws, draws, cases.SPAN, 1, Robustness())[0]
    factors = margins_of(gains, draws, 1).gain
    for row in (0, 7):
        theta = cases.theta(draws.actuator, 20, name)[row : row + 1]
        single = SampledModel.of(draws.actuator, theta)
        inside, beyond = (
            largest_pole(scaled(gains, factor * factors[row]), single) for factor in (0.98, 1.02)
        )
        assert inside < 1 < beyond


@every_actuator
@pytest.mark.parametrize("delay", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (0, 3))])
def test_a_design_keeps_its_margins_and_is_the_fastest(name: str, delay: int) -> None:
    draws = models(name)
    required = Robustness(2.5, 50.0)
    gains, result = design(draws, draws, cases.SPAN, delay, required)
    assert result.stable
    assert (result.gain >= required.gain).all()
    assert (result.phase >= required.phase).all()
    faster = margins_of(scaled(gains, 1.03), draws, delay)
    kept = (faster.gain >= required.gain) & (faster.phase >= required.phase) & (faster.circle > 0)
    assert not kept.all()


def test_the_controllers_zeros_are_the_models_poles() -> None:
    draws = models("bouc-wen, second-order", 1)
    gains, _ = design(draws, draws, cases.SPAN, 1, Robustness())
    poles = np.roots(draws.sections.denominator[0, 0])
    np.testing.assert_allclose(np.roots(gains.steps), poles, atol=1e-12)
    # As K_p e + K_i ∫ e + K_d e′ in steps: backward differences.
    first, second, third = gains.steps
    assert first == pytest.approx(
        gains.proportional + gains.integral * 1e-3 + gains.derivative / 1e-3
    )
    assert second == pytest.approx(-gains.proportional - 2 * gains.derivative / 1e-3)
    assert third == pytest.approx(gains.derivative / 1e-3)


def test_slopes_that_change_from_sample_to_sample_leave_it_stable() -> None:
    """The circle criterion's promise, tried: increments die out whatever the slopes are."""
    draws = models("bouc-wen, second-order", 3)
    gains, result = design(draws, draws, cases.SPAN, 1, Robustness())
    assert (result.circle > 0).all()
    generator = np.random.default_rng(3)
    least, largest = draws.slopes(cases.SPAN)
    _, first, second = draws.sections.numerator[0, 0]
    _, back, far = draws.sections.denominator[0, 0]
    worst = 0.0
    for _ in range(20):
        x, w, errors, queue = [1.0, 0.9], [0.0, 0.0], [0.0, 0.0], [0.0]
        for _ in range(400):
            errors.append(-x[-1])
            change = sum(q * e for q, e in zip(gains.steps, errors[:-4:-1], strict=True))
            queue.append(change)
            slope = generator.choice([least[0], largest[0]])
            # Increments of the drive; the displacement's own sum them up.
            w.append(w[-1] + slope * queue.pop(0))
            x.append(first * w[-1] + second * w[-2] - back * x[-1] - far * x[-2])
        worst = max(worst, abs(x[-1]))
    assert worst < 1e-6


def test_a_slope_that_may_vanish_is_refused() -> None:
    actuator = Actuator("none", "zero")
    theta = cases.theta(actuator)
    theta[0, actuator.parameters.index("d")] = 0.4
    one = SampledModel.of(actuator, theta)
    with pytest.raises(InputError, match="slopes as low as"):
        design(one, one, cases.SPAN, 1, Robustness())


# The promise of tracking: with feed-forward, PID control follows better than with either alone


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


# On the virtual stand, feedback with feed-forward beats either alone, over seeds of its record.
# As a user would have it: a record of the ring bender is fitted, the posterior's mean is the model
# that the controller has, and its draws are the actuators; then the stand's own actuator, whose
# truth no draw is.


SEEDS = 5
DRAWS = 200
LIMITS = (-100.0, 100.0)

# Up to 20 Hz; beyond, the dynamics take what the amplifier can give.
FREQUENCIES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)


def fitted(seed: int) -> bw.Run:
    """Return a fit of the paper's record, from the virtual stand with a discrepancy."""
    record = bw.VirtualTestStand().run(bw.signal("identification"), generator(seed, "record"))
    fixed = {"mass": {"fixed": 0.00134}, "stiffness": {"fixed": 4.10e5}}
    return bw.fit(
        record,
        dynamics="second-order",
        from_rest=True,
        parameters=fixed,
        seed=seed,
        ess=1000,
        progress=False,
        workers=1,
    )


def on_the_stand(fit: bw.Run) -> Tracking:
    """Return how well the true actuator follows, in as many runs as there were draws."""
    one = fit.study.posterior.single_record
    stand = bw.VirtualTestStand()
    known = stand.parameters()
    truth = np.array([[known[name] for name in one.actuator.parameters]])
    every = fit.study.posterior.prior.theta(fit.result.flat_draws[:1000])
    return track(
        stand.actuator,
        np.tile(truth, (DRAWS, 1)),
        cases.noise_of(DRAWS, known["sensor_sd"], PROCESS_SD, PROCESS_TIME),
        Stand(Limits(*LIMITS)),
        np.random.default_rng(1),
        frequencies=FREQUENCIES,
        all_theta=one.table.actuator(every),
    )


@pytest.mark.slow
def test_feedback_with_feed_forward_is_best_up_to_20_hz() -> None:
    """On every signal and at every frequency, for at least 95% of the draws.

    On the stand's own actuator the mean error of many runs is less; in how many single runs it is,
    where steps come so fast that the two hardly differ, is kept as a figure.
    """
    draws, runs, ratios = [], [], []
    for seed in range(1, SEEDS + 1):
        fit = fitted(seed)
        made = fit.track(frequencies=FREQUENCIES, voltage=LIMITS, draws=DRAWS)
        assert made.margins.stable
        assert made.margins.gain.min() >= made.robustness.gain
        real = on_the_stand(fit)
        draws.append(float(made.best.min()))
        runs.append(float(real.best.min()))
        mean = real.rms.mean(axis=-1)
        ratios.append((np.minimum(mean[1], mean[2]) / mean[3]).min())
    keep(
        "closed loop",
        {
            "seeds": SEEDS,
            "draws": DRAWS,
            "least_share_of_draws": min(draws),
            "least_share_of_runs": min(runs),
            "least_ratio": float(min(ratios)),
        },
    )
    assert min(draws) >= 0.95
    assert min(ratios) > 1

"""On the virtual stand, feedback with feed-forward beats either alone, over seeds of its record.

As a user would have it: a record of the ring bender is fitted, the posterior's mean is the model
that the controller has, and its draws are the actuators; then the stand's own actuator, whose truth
no draw is.
"""

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.control.loop import Stand
from bwbayes.control.tracking import Tracking, track
from bwbayes.inference.study import generator
from bwbayes.model.inputs import Limits
from bwbayes.record.teststand import PROCESS_SD, PROCESS_TIME
from tests.control import cases
from tests.measured import keep

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

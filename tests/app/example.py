"""A small finished run to draw and to report, made up without any sampling."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bwbayes.arrays import FloatArray
from bwbayes.inference.parameters import Parameter
from bwbayes.model.declaration import Distribution
from bwbayes.prediction.bands import KINDS, Bands, Scores
from bwbayes.report.figures import draw_styled, pictures, plots_of
from bwbayes.report.result import Result, render, summary
from bwbayes.report.run import run_report
from bwbayes.sampling.diagnostics import ConvergenceDiagnostics, SamplingResult
from tests.declared import declared
from tests.prediction.records import normal_bands


def _of(name: str, description: str, known: Distribution | float) -> Parameter:
    return dataclasses.replace(Parameter.of(declared(name), known), description=description)


PARAMETERS = (
    _of("d", "coefficient", Distribution("normal", {"mean": 0.7, "sd": 0.1})),
    _of("alpha", "part", Distribution("normal", {"mean": 0.3, "sd": 0.1})),
    _of("exponent", "smoothness", 1.0),
    _of("lag", "lag", Distribution("halfnormal", {"scale": 1e-3})),
    _of("stiffness", "stiff", Distribution("uniform", {"lower": 0, "upper": 1e6})),
)
MEANS = np.array([0.7, 0.36, 2e-3, 4.1e5])
SDS = np.array([6e-3, 8e-3, 1.5e-5, 1.2e3])


def bands(
    name: str = "held-out",
    samples: int = 3000,
    lead_in: int = 300,
    measured: bool = True,
    training: bool = False,
) -> Bands:
    """Make up bands of a sine at 1000 Hz, with sds of 0.3, 0.8 and 1 um."""
    generator = np.random.default_rng(samples)
    time = np.arange(samples) / 1000
    voltage = 100 * np.sin(2 * np.pi * time)
    mean = 0.7 * voltage - 10 * np.cos(2 * np.pi * time)
    truth = mean + 0.8 * np.sin(7 * time)
    reading = truth + 0.6 * generator.standard_normal(samples)
    sds = {kind: np.full(samples, sd) for kind, sd in zip(KINDS, (0.3, 0.8, 1.0), strict=True)}
    made = normal_bands(time, voltage, mean, sds, reading if measured else None, training=training)
    return dataclasses.replace(
        made, name=name, truth=truth if measured else None, scored_from=lead_in
    )


def scores(truth: bool = True) -> Scores:
    return Scores(
        nrmse=0.0123,
        max_error_um=5.52,
        log_score=-1.32,
        crps_um=0.817,
        width_um={50: 2.11, 90: 5.12, 95: 6.13},
        interval_score_um={50: 5.21, 90: 8.22, 95: 9.23},
        coverage={
            "sensor": {50: 0.481, 90: 0.892, 95: 0.943},
            "displacement": {50: 0.514, 90: 0.915, 95: 0.966} if truth else None,
        },
        coverage_error={
            "sensor": {50: 0.041, 90: 0.022, 95: 0.013},
            "displacement": {50: 0.054, 90: 0.025, 95: 0.016} if truth else None,
        },
        worst_second={50: 0.121, 90: 0.552, 95: 0.703},
    )


def scored(every: Iterable[Bands], known: Scores) -> tuple[Bands, ...]:
    """Give bands with readings these scores."""
    return tuple(
        bands if bands.measured is None else dataclasses.replace(bands, scores=known)
        for bands in every
    )


def draws(steps: int = 120, walkers: int = 10) -> FloatArray:
    """Draw independently: (steps, 4, walkers, 4)."""
    return MEANS + SDS * np.random.default_rng(1).standard_normal((steps, 4, walkers, 4))


def check(steps: int) -> ConvergenceDiagnostics:
    """Return a check that is content, its numbers told apart by parameter."""
    each = np.arange(4.0)
    return ConvergenceDiagnostics(
        steps=steps,
        rhat=1.001 + 0.001 * each,
        ess_bulk=2100 + each,
        ess_tail=2200 + each,
        ess_mean=2300 + each,
        autocorrelation=np.ones(4),
        acceptance=0.28,
        stuck=0,
        pareto_k=0.314,
    )


def run(
    converged: bool = True,
    values: FloatArray | None = None,
    parameters: tuple[Parameter, ...] = PARAMETERS,
    every: tuple[Bands, ...] | None = None,
) -> Result:
    """Make up a run: a training stretch and one that was held out, unless told otherwise."""
    values = draws() if values is None else values
    if every is None:
        every = (bands("training", 2500, 0, training=True), bands())
    every = every if converged else ()
    return Result(
        name="bender",
        outcome=SamplingResult(
            converged,
            "two good checks" if converged else "step limit 120 reached: R-hat 1.2",
            check(values.shape[0]),
        ),
        parameters=parameters,
        draws=values,
        log_density=np.zeros(values.shape[:3]),
        moves={"differential evolution": (1000, 123), "mixture": (3800, 1221)},
        predictions=scored(every, scores()),
        facts={"record": "made up", "drive": "-100 to 100 V"},
        remarks=("the sensor was clipped",),
        truth={"d": 0.7, "lag": 2e-3},
    )


def page(
    run: Result,
    numbers: Mapping[str, Any] | None = None,
    pictures: Mapping[str, bytes] | None = None,
) -> str:
    report = run_report(run, summary(run) if numbers is None else numbers)
    return render(report, pictures or {}, plots_of(run))


def figures(run: Result) -> dict[str, Figure]:
    return {name: draw_styled(picture.draw) for name, picture in pictures(run).items()}

"""Bayesian uncertainty of piezoelectric actuators with the Bouc-Wen hysteresis model.

A record of voltage and displacement becomes a posterior of the actuator's parameters, and the
posterior becomes bands in which the displacement will be, for any voltage:
``fit = bwbayes.fit(record)`` samples until the chain has converged, and then there is
``fit.predict(new_record)``. What :func:`fit` is made of is here too: a :class:`Problem` holds
record, model and priors, :func:`sample` draws. So is the forward model alone, for a batch of
parameters::

    import numpy as np
    import bwbayes

    voltage = 100 * np.sin(2 * np.pi * np.arange(0, 2, 1e-3))  # V
    h = bwbayes.hysteresis(voltage, alpha=[0.30, 0.36], beta=0.027, gamma=0.017)  # (2, 2000), um

The names here are what a Python user needs; each is loaded when it is first used, so that
``import bwbayes`` costs nothing. ``notebooks/quickstart.ipynb`` shows them at work, and the
modules they come from hold the rest.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

__all__ = [
    "Actuator",
    "Background",
    "Bands",
    "Calibration",
    "Campaign",
    "Chain",
    "Config",
    "Distribution",
    "Experiment",
    "Finding",
    "Fit",
    "InputError",
    "InputWarning",
    "JointPrior",
    "Loops",
    "NotConvergedError",
    "Outcome",
    "Parameter",
    "PointFit",
    "Population",
    "Posterior",
    "Prediction",
    "Problem",
    "Record",
    "Replicate",
    "SamplingPlan",
    "Scores",
    "Start",
    "Step",
    "StepResponse",
    "Verdict",
    "VirtualTestStand",
    "Waveform",
    "assess",
    "campaign",
    "compare",
    "draws",
    "first_chain",
    "fit",
    "forecast",
    "hysteresis",
    "inspect",
    "judge",
    "load_config",
    "measure_loops",
    "measure_step",
    "noise_model",
    "open_run",
    "parse_config",
    "point_fit",
    "predict_record",
    "predict_windows",
    "read_record",
    "replicates",
    "resolve",
    "resume_run",
    "sample",
    "score",
    "signal",
    "thinned",
    "write_record",
]

if TYPE_CHECKING:
    from bwbayes.app.config.config import Config
    from bwbayes.app.config.config import load as load_config
    from bwbayes.app.config.config import parse as parse_config
    from bwbayes.app.fit.calls import compare, fit, open_run, resume_run
    from bwbayes.app.fit.campaigns import Campaign, campaign
    from bwbayes.app.fit.fitted import Fit
    from bwbayes.app.problem.problem import Problem, resolve
    from bwbayes.app.running.predictions import Prediction
    from bwbayes.data.inspection import Finding, inspect
    from bwbayes.data.io.formats import read_record, write_record
    from bwbayes.data.record import Record
    from bwbayes.data.teststand import VirtualTestStand
    from bwbayes.data.waveforms import Waveform, signal
    from bwbayes.errors import InputError, InputWarning, NotConvergedError
    from bwbayes.inference.noise import noise_model
    from bwbayes.inference.parameters import JointPrior, Parameter
    from bwbayes.inference.pointfit import PointFit
    from bwbayes.inference.pointfit import fit as point_fit
    from bwbayes.inference.posterior import Posterior
    from bwbayes.model.actuator import Actuator
    from bwbayes.model.boucwen import hysteresis
    from bwbayes.model.distributions import Distribution
    from bwbayes.population.population import Population
    from bwbayes.results.bands import Bands
    from bwbayes.results.calibration import Calibration, judge
    from bwbayes.results.loops import Loops, measure_loops
    from bwbayes.results.prediction import forecast, predict_record, predict_windows, thinned
    from bwbayes.results.replicates import Experiment, Replicate, replicates
    from bwbayes.results.scores import Scores, score
    from bwbayes.results.start import Start
    from bwbayes.results.steps import Step, StepResponse, measure_step
    from bwbayes.results.verdict import Background, Verdict, assess
    from bwbayes.sampling.chain import Chain
    from bwbayes.sampling.plan import SamplingPlan
    from bwbayes.sampling.sampler import Outcome, draws, first_chain, sample
else:
    # The module of each name, and what it is called there if not the same.
    HOMES = {
        "Actuator": "model.actuator",
        "Background": "results.verdict",
        "Bands": "results.bands",
        "Calibration": "results.calibration",
        "Campaign": "app.fit.campaigns",
        "Chain": "sampling.chain",
        "Config": "app.config.config",
        "Distribution": "model.distributions",
        "Experiment": "results.replicates",
        "Finding": "data.inspection",
        "Fit": "app.fit.fitted",
        "InputError": "errors",
        "InputWarning": "errors",
        "JointPrior": "inference.parameters",
        "Loops": "results.loops",
        "NotConvergedError": "errors",
        "Outcome": "sampling.sampler",
        "Parameter": "inference.parameters",
        "PointFit": "inference.pointfit",
        "Population": "population.population",
        "Posterior": "inference.posterior",
        "Prediction": "app.running.predictions",
        "Problem": "app.problem.problem",
        "Record": "data.record",
        "Replicate": "results.replicates",
        "SamplingPlan": "sampling.plan",
        "Scores": "results.scores",
        "Start": "results.start",
        "Step": "results.steps",
        "StepResponse": "results.steps",
        "Verdict": "results.verdict",
        "VirtualTestStand": "data.teststand",
        "Waveform": "data.waveforms",
        "assess": "results.verdict",
        "campaign": "app.fit.campaigns",
        "compare": "app.fit.calls",
        "draws": "sampling.sampler",
        "first_chain": "sampling.sampler",
        "forecast": "results.prediction",
        "fit": "app.fit.calls",
        "hysteresis": "model.boucwen",
        "inspect": "data.inspection",
        "judge": "results.calibration",
        "load_config": "app.config.config:load",
        "measure_loops": "results.loops",
        "measure_step": "results.steps",
        "noise_model": "inference.noise",
        "open_run": "app.fit.calls",
        "parse_config": "app.config.config:parse",
        "point_fit": "inference.pointfit:fit",
        "predict_record": "results.prediction",
        "predict_windows": "results.prediction",
        "read_record": "data.io.formats",
        "replicates": "results.replicates",
        "resolve": "app.problem.problem",
        "resume_run": "app.fit.calls",
        "sample": "sampling.sampler",
        "score": "results.scores",
        "signal": "data.waveforms",
        "thinned": "results.prediction",
        "write_record": "data.io.formats",
    }

    def __getattr__(name: str) -> object:
        """Load a public name from the module that it lives in."""
        if name not in HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, _, original = HOMES[name].partition(":")
        return getattr(import_module(f"{__name__}.{module}"), original or name)


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted(__all__)

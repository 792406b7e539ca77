"""A config as a study: its model, parameters, stand and sampling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bwbayes.app.config.config import Config
from bwbayes.app.config.settings import ParameterConfig
from bwbayes.errors import InputError
from bwbayes.inference.engine import resolve_engine
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Slices, Stated, Study, Validation, extent_of
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Distribution
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.record import Record
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.sampling.plan import SamplingPlan, best_ahead, best_ensembles_per_task, best_tries


def study_of(
    config: Config,
    records: Mapping[str, Record],
    training: Mapping[str, Slices] | None = None,
    validations: Mapping[str, Validation] | None = None,
) -> Study:
    """Return what a config fits to these records, in ``training`` windows, and holds against them.

    Raises InputError: a prior that is none.
    """
    return Study(
        config.model.spec,
        records,
        training or {},
        frozenset(name for name in records if config.records[name].from_rest),
        {name: _stated(name, parameter) for name, parameter in config.parameters.items()},
        tuple(config.model.per_record),
        tuple(config.model.shared),
        resolve_engine(config.sampling.engine),
        validations or {},
        config.seed,
    )


def _stated(name: str, parameter: ParameterConfig) -> Stated:
    """Return what a config says of a parameter."""
    prior = None
    if parameter.prior is not None:
        arguments = {key: v for key, v in parameter.prior.items() if key != "distribution"}
        try:
            # The distribution itself refuses arguments that are not numbers.
            prior = Distribution(str(parameter.prior["distribution"]), arguments)  # type: ignore[arg-type]
        except InputError as error:
            raise InputError(f"parameters.{name}.prior: {error}") from None
    others = parameter.model_dump(exclude={"prior"})
    return Stated(prior, **others)


def stand_of(config: Config, training: Sequence[Record]) -> VirtualTestStand:
    """Return the virtual stand that a config asks for.

    Gain and creep count from the range of the ``training`` records' voltages, as in a fit to them,
    so that a fit can recover their true values. Refused (InputError) are a part that does not
    exist, an option that it does not have, and a true value of no parameter of the actuator.
    """
    stand = config.stand
    try:
        first, extent = training[0], extent_of(training)
        actuator = stand.model.spec.actuator(first.interval, first.hold, extent)
    except InputError as error:
        raise InputError(f"stand.{error}") from None
    return VirtualTestStand(
        stand.discrepancy, stand.sample_rate, actuator=actuator, true=stand.parameters
    )


def recoverable(stand: VirtualTestStand, fitted: Actuator) -> dict[str, float]:
    """Return the true values, except those that mean something else in a fitted actuator.

    Parts that differ may have parameters of the same name.
    """
    other = set[str]()
    parts = stand.actuator.hysteresis, fitted.hysteresis
    # Whether Bouc-Wen hysteresis is passive says where its parameters may lie, not what they mean.
    if parts[0] != parts[1] and not all(isinstance(operator, BoucWen) for operator in parts):
        other |= {declared.name for declared in fitted.hysteresis.parameters}
    if fitted.creep and stand.actuator.creep and fitted.creep.times != stand.actuator.creep.times:
        other |= {declared.name for declared in fitted.creep.parameters}
    return {name: value for name, value in stand.parameters().items() if name not in other}


def plan_of(config: Config, posterior: Posterior) -> SamplingPlan:
    """Return how a posterior is sampled.

    Raises InputError: too few walkers.
    """
    settings, prior = config.sampling, posterior.prior
    fewest = 2 * prior.dimensions
    # Halves of an ensemble fill the compiled engine's lanes; with six more than the fewest
    # complementary halves span all directions.
    common = 64 if posterior.engine == "numba" else 32
    walkers = settings.walkers or max(fewest + 6, common)
    if walkers < fewest:
        raise InputError(
            f"sampling.walkers: {walkers} are too few for {prior.dimensions} free parameters; "
            f"use at least {fewest}"
        )
    samples = sum(dataset.readings.samples for dataset in posterior.datasets)
    readings = sum(len(data.readings.values) for data in posterior.datasets)
    return SamplingPlan(
        ess=settings.ess,
        ensembles=settings.ensembles,
        walkers=walkers,
        block=settings.block,
        max_steps=settings.steps,
        max_pilot_steps=settings.pilot_steps,
        ensembles_per_task=best_ensembles_per_task(settings.ensembles, walkers, samples),
        tries=best_tries(walkers, readings),
        ahead=best_ahead(walkers, samples),
    )

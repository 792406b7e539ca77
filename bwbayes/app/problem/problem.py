"""From a config to a problem: records read, windows cut, every prior a number.

:func:`resolve` does once what must not happen twice: it runs the virtual stand, sets default
priors, and takes ``hold = "auto"`` from the record. The resulting config says all this in explicit
numbers and refers to the records as files beside it. So a run's folder can be moved, continued and
run again by itself.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np

from bwbayes.app.config.config import ALONE, Config
from bwbayes.app.config.settings import RecordConfig
from bwbayes.app.problem.column_options import record_naming
from bwbayes.app.problem.parameters import as_config, recoverable, study_of
from bwbayes.app.problem.records import (
    Slices,
    Validation,
    findings_of,
    generator,
    join_records,
    set_aside,
    training_records,
    unlike,
    validations_of,
    windows_of,
    without_clock,
)
from bwbayes.arrays import FloatArray, IntArray
from bwbayes.diagnosis.extrapolation import Drive, beyond_training, unexcited
from bwbayes.diagnosis.finding import Finding
from bwbayes.diagnosis.record_checks import UNTOLD, isolated_outliers
from bwbayes.errors import InputError, InputWarning
from bwbayes.inference.outliers import outliers
from bwbayes.inference.parameters import Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import Stated, Study, require_known
from bwbayes.model.declaration import Distribution
from bwbayes.model.spec import ModelSpec
from bwbayes.quantities import Quantities
from bwbayes.record import Record
from bwbayes.record.instruments import EXACT, Scales
from bwbayes.sampling.plan import (
    SamplingPlan,
    best_ahead,
    best_ensembles_per_task,
    best_tries,
)
from bwbayes.shown import brief


@dataclass(frozen=True)
class Problem:
    """All that a run needs, and the config that says the same in explicit numbers.

    ``defaults`` are what the default priors of its records would be, by the parameters' name.
    """

    __repr__ = brief

    config: Config
    study: Study
    posterior: Posterior
    plan: SamplingPlan
    validations: Mapping[str, Validation]
    defaults: Mapping[str, Distribution] = field(default_factory=dict)

    @cached_property
    def records(self) -> dict[str, Record]:
        """The records that are fitted, by name."""
        return {name: training.record for name, training in self.study.records.items()}

    @cached_property
    def findings(self) -> dict[str, tuple[Finding, ...]]:
        """Issues of each fitted record that matter to the model.

        Several records make up for what one of them does not show, and a model without hysteresis
        needs no loops.
        """
        no_matter: tuple[str, ...] = ()
        if len(self.records) > 1:
            no_matter += UNTOLD
        if self.config.model.hysteresis == "linear":
            no_matter += tuple(kind for kind in UNTOLD if kind != "few readings")
        return {
            name: tuple(
                finding
                for finding in findings_of(record, [*chain(*self.windows(name).values())])
                if finding.kind not in no_matter
            )
            for name, record in self.records.items()
        }

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """Notes on the records, one line each."""
        sources = self.config.records
        remarks = [text for source in sources.values() for text in source.remarks or ()]
        measured = {**self.records, **self.others}
        remarks += [f"{n}: {r.path.remark}" for n, r in measured.items() if r.path.remark]
        remarks += [
            f"{name}: {finding}" for name, all_ in self.findings.items() for finding in all_
        ]
        remarks += [text for name, other in self.others.items() for text in unlike(name, other)]
        remarks += [
            (f"{name}: " if len(self.records) > 1 else "") + set_aside(source.outliers, record)
            for (name, source), record in zip(sources.items(), self.records.values(), strict=True)
            if source.outliers is not None
        ]
        for name, beyond in self.extrapolations.items():
            notes = (unexcited(beyond), *(finding.note for finding in beyond))
            remarks += [f"{name}: {note}" for note in notes if note]
        return tuple(remarks)

    @property
    def record(self) -> Record:
        """The record that is fitted; of several, the first."""
        return next(iter(self.records.values()))

    @property
    def quantities(self) -> Quantities:
        """Quantities of its records, in whose words all is said."""
        return self.record.quantities

    @property
    def sha256(self) -> str:
        """A digest of all that was measured."""
        return self.study.data_sha256

    @property
    def digests(self) -> dict[str, str]:
        """The digest of each record by name, of those that are fitted and those predicted."""
        return {name: record.sha256 for name, record in {**self.records, **self.others}.items()}

    @property
    def facts(self) -> dict[str, str]:
        """The fitted model and records, for people: one line each, by subject."""
        facts = {}
        for name, record in self.records.items():
            which = "" if len(self.records) == 1 else f" {name}"
            low, high = record.range_voltage
            clock = f" every {record.interval:g} s" if record.quantities.has_clock else ""
            fact = (
                f"{record.origin}: {record.samples} samples{clock}, "
                f"{low:.4g} to {high:.4g} V ({record.voltage_is}), {record.readings} readings"
            )
            if gap := record.longest_gap:
                fact += f", none from {record.clock(gap[0])} to {record.clock(gap[1])} s"
            if missing := self.config.records[name].missing:
                fact += f" ({' and '.join(f'{value:g}' for value in missing)} um taken as missing)"
            facts[f"record{which}"] = fact
            facts[f"start{which}"] = _start(
                record,
                from_rest=self.config.records[name].from_rest,
                demagnetized=self.config.model.history == "demagnetized",
            )
            facts[f"fitted{which}"] = ", ".join(
                f"{record.time[w.start]:g} to {record.time[w.stop - 1]:g} s"
                for w in self.posterior.for_record(name).single_record.training
            )
        facts |= self.record.instruments.facts
        drive = str(Drive.of(self.posterior))
        model, noise = str(self.study.spec), self.config.model.noise
        return facts | {"drive": drive, "model": model, "noise": noise}

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters of the model and the noise."""
        return self.posterior.prior.parameters

    @property
    def others(self) -> dict[str, Record]:
        """The records that are predicted, by name, besides those that are fitted."""
        records = {name: validation.record for name, validation in self.validations.items()}
        return {name: record for name, record in records.items() if record is not None}

    @cached_property
    def extrapolations(self) -> dict[str, list[Finding]]:
        """In what the drive of each validation leaves the training data, by its name."""
        beyond_by_name = {}
        for name, validation in self.validations.items():
            record, windows = validation.record or self.records[validation.of], validation.windows
            window = slice(windows[0].start, windows[-1].stop) if windows else slice(None)
            beyond = beyond_training(self.posterior, record.inputs, window)
            # A held-out part goes on with the loops of the rest, and its readings test them.
            is_window = validation.record is None
            beyond_by_name[name] = [
                finding for finding in beyond if not (is_window and finding.kind == "reversals")
            ]
        return beyond_by_name

    def scales(self, draws: int) -> Scales:
        """Return the scales of the instruments for so many draws."""
        return self.record.instruments.scales(draws, generator(self.config.seed, "instruments"))

    def true_draws(self, read: FloatArray) -> FloatArray:
        """Return draws (..., free), as the readings have them, in true um and V."""
        if self.record.instruments == EXACT:
            return read
        flat, names = read.reshape(-1, read.shape[-1]), self.posterior.names
        scales, parameters = self.scales(len(flat)), {p.name: p for p in self.parameters}
        exponent: float | FloatArray | None = 1.0
        if "exponent" in parameters:
            exponent = parameters["exponent"].fixed
        if exponent is None:
            exponent = flat[:, names.index("exponent")]
        factors = [scales.factor(parameters[name].unit, exponent) for name in names]
        return (flat * np.stack(factors, axis=1)).reshape(read.shape)

    def with_noise(self, chosen: str) -> Problem:
        """Return the problem of a run whose noise, ``auto``, came to this one.

        As it is, if its config names a noise, or none is chosen yet.
        """
        if self.config.model.noise != "auto" or chosen == "auto":
            return self
        return self.with_model(replace(self.study.spec, noise=chosen), noise=chosen)

    def with_model(
        self,
        spec: ModelSpec,
        stated: Mapping[str, Stated] | None = None,
        remarks: Sequence[str] = (),
        **keys: object,
    ) -> Problem:
        """Return the problem of another model of the same readings.

        ``stated`` is stated of new parameters, ``remarks`` are added to those of the records, and
        ``keys`` are what [model] says from now on.
        """
        changes: dict[str, object] = {"model": self.config.model.model_copy(update=keys)}
        if remarks:
            record = self.config.record
            assert isinstance(record, RecordConfig)
            noted = [*(record.remarks or []), *remarks]
            changes["record"] = record.model_copy(update={"remarks": noted})
        config = self.config.model_copy(update=changes)
        if spec != self.study.spec or stated:
            return _problem(config, self.study.with_model(spec, stated), self.validations)
        same = copy(self)  # with all that is known of it
        object.__setattr__(same, "config", config)
        vars(same).pop("remarks", None)
        return same

    def windows(self, record: str) -> dict[str, tuple[slice, ...]]:
        """Return the windows of a training record by the names of their bands, fitted ones first.

        Those of one record alone are called "training", those of several as their record is.
        """
        training = self.posterior.for_record(record).single_record.training
        name = "training" if len(self.records) == 1 else record
        return {name: training, **self.held_out(record)}

    def held_out(self, record: str) -> dict[str, tuple[slice, ...]]:
        """Return the windows of a training record that were held out, by name."""
        validations = self.validations.items()
        return {name: v.windows for name, v in validations if v.windows and v.of == record}


def resolve_config(
    config: Config, folder: Path, records: Mapping[str, Record] | None = None
) -> Problem:
    """Make a problem of a config whose files are relative to ``folder``.

    ``records`` are those that are not read from the config's files because they are in memory:
    training records ("record", if there is one alone), and others by the names of their
    validations.

    Raises InputError: anything in the config or the records that cannot be used.
    """
    in_memory = records or {}
    first, source = next(iter(config.records.items()))
    stated = in_memory[first].quantities if first in in_memory else None
    with (stated or Quantities.of(source.input, source.output)).spoken():
        return _resolved(config, folder, in_memory)


def _resolved(config: Config, folder: Path, in_memory: Mapping[str, Record]) -> Problem:
    """Make a problem of a config, as :func:`resolve_config`."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        fitted, stand = training_records(config, folder, in_memory)
        config, untimed = without_clock(config, fitted)
        config, fitted = join_records(config, fitted)
        training, held_out = windows_of(config, fitted)
        validations = validations_of(config, folder, fitted, held_out, in_memory)
    remarks = [text for source in config.records.values() for text in source.remarks or ()]
    remarks += [str(w.message) for w in caught if issubclass(w.category, InputWarning)]
    remarks += untimed
    aside = {name: source.outliers for name, source in config.records.items()}
    if config.model.outliers:
        aside |= _outliers(config, fitted, training, [n for n, t in aside.items() if t is None])
    study = study_of(config, fitted, training)
    require_known("truth", config.truth, study.posterior.table, elsewhere=True)
    actuator = study.posterior.datasets[0].actuator
    remarks += [
        f"loops and step responses leave out what {stage.name} makes of {stage.sees}"
        for stage in actuator.without_events.stages
        if stage.sees and not stage.rate_independent
    ]
    truth = recoverable(stand, actuator) if stand else {}
    sources = {
        name: source.model_copy(
            update={
                "outliers": aside[name],
                "read_as": source.read_as
                or (None if name in in_memory else record_naming(source, folder)),
                # Said while all were read: the first has them.
                "remarks": list(dict.fromkeys(remarks))
                if name == next(iter(config.records))
                else None,
            }
        )
        for name, source in config.records.items()
    }
    alone = isinstance(config.record, RecordConfig)
    noted = {"record": sources[ALONE] if alone else sources, "truth": {**truth, **config.truth}}
    return _problem(config.model_copy(update=noted), study, validations)


def _problem(config: Config, study: Study, validations: Mapping[str, Validation]) -> Problem:
    """Return the problem of a study, which a config describes, though not in explicit numbers."""
    plan = _plan(config, study.posterior)
    explicit = _explicit(config, study, plan)
    records = {name: training.record for name, training in study.records.items()}
    windows = {name: training.windows for name, training in study.records.items()}
    # As the config says it from now on, in explicit numbers.
    stated = study_of(explicit, records, windows)
    return Problem(explicit, stated, study.posterior, plan, validations, study.defaults)


def _start(record: Record, *, from_rest: bool, demagnetized: bool) -> str:
    """Say what is taken of a record's start, and what declaring it from rest would change."""
    if from_rest:
        return f"{record.beginning}, demagnetized and at rest, as from_rest declares"
    if demagnetized:
        return (
            f"{record.beginning}; the hysteresis was demagnetized before, as history declares; how "
            "the dynamics move then is estimated"
        )
    unknown = "; the hysteresis's state and how the dynamics move then are estimated"
    hint_from_rest = "; if it was demagnetized and nothing moved, from_rest = true makes them known"
    return f"{record.beginning}{unknown}{hint_from_rest * record.starts_at_zero}"


def _outliers(
    config: Config, records: dict[str, Record], training: Mapping[str, Slices], names: list[str]
) -> dict[str, list[float]]:
    """Leave isolated outliers out of the ``records`` of these names; return their times, s.

    Their ranges would make the default priors, so these are made anew without them.
    """
    complete = dict(records)

    def posterior_without(rows: Mapping[str, IntArray]) -> Posterior:
        records.update({n: complete[n].without(rows[n]) for n in names if n in rows})
        return study_of(config, records, training).posterior

    rows = outliers(
        posterior_without,
        generator(config.seed, "outliers"),
        {name: isolated_outliers(complete[name], ends=True) for name in names},
    )
    records.update({name: complete[name].without(rows[name]) for name in names})
    return {name: complete[name].time[rows[name]].tolist() for name in names}


def _plan(config: Config, posterior: Posterior) -> SamplingPlan:
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


def _explicit(config: Config, study: Study, plan: SamplingPlan) -> Config:
    """Return the config in explicit numbers and words, with records as files beside it."""
    posterior, truth = study.posterior, config.truth
    parameters = posterior.prior.parameters
    records = {
        name: RecordConfig(
            file=f"records/{name}.h5",
            train=source.train,
            from_rest=source.from_rest,
            missing=source.missing,
            outliers=source.outliers,
            read_as=source.read_as,
            remarks=source.remarks or None,
            input=source.input,
            output=source.output,
        )
        for name, source in config.records.items()
    }
    naming = ("columns", "units", "fs", "table", "displacement_file", "covariates")
    as_read = dict.fromkeys(("signal", "voltage_is", "linearity", *naming))
    validation = {
        name: v.model_copy(update={"file": f"records/{name}.h5", **as_read}) if v.another else v
        for name, v in config.validation.items()
    }
    scopes = {"per_record": [*study.per_record], "shared": [*study.shared]}
    model = config.model.with_spec(study.spec.explicit(posterior.datasets[0].actuator))
    true = {p.name: truth.get(p.name, truth.get(p.plain)) for p in parameters}
    sampling = {"walkers": plan.walkers, "engine": posterior.engine}
    return config.model_copy(
        update={
            "record": records[ALONE] if isinstance(config.record, RecordConfig) else records,
            "model": model.model_copy(update=scopes),
            "sampling": config.sampling.model_copy(update=sampling),
            "parameters": {p.name: as_config(p, study.quantities) for p in parameters},
            "truth": {name: value for name, value in true.items() if value is not None},
            "validation": validation,
        }
    )

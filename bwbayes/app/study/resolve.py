"""From a config to a run: records read, windows cut, every prior a number.

:func:`resolve_config` does once what must not happen twice: it runs the virtual stand, sets default
priors, and leaves out outliers. The resulting config says all this in explicit numbers and refers
to the records as files beside it. So a run's folder can be moved, continued and run again by
itself.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from bwbayes.app.config.config import ALONE, Config, ModelConfig, ParameterConfig, RecordConfig
from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.from_config import (
    join_records,
    record_naming,
    recoverable,
    require_alike,
    study_of,
    training_records,
    validations_of,
    windows_of,
)
from bwbayes.diagnosis.record_checks import isolated_outliers
from bwbayes.errors import InputWarning
from bwbayes.inference.outliers import outliers
from bwbayes.inference.study import Stated, Study, declarations_of, require_known
from bwbayes.model.spec import ModelSpec
from bwbayes.quantities import Quantities
from bwbayes.record import Record
from bwbayes.record.teststand import VirtualTestStand


def resolve_config(
    config: Config, folder: Path, records: Mapping[str, Record] | None = None
) -> Run:
    """Make a run of a config whose files are relative to ``folder``; it is in no folder yet.

    ``records`` are those that are not read from the config's files because they are in memory:
    training records ("record", if there is one alone), and others by the names of their
    validations.

    Raises InputError: anything in the config or the records that cannot be used.
    """
    with _quantities(config, records or {}).spoken():
        return _resolve(*_read_records(config, folder, records or {}))


def resolve_models(
    config: Config,
    folder: Path,
    models: Mapping[str, ModelConfig],
    records: Mapping[str, Record],
) -> dict[str, Run]:
    """Make a run of a config with each of several models, by name; its records are read once.

    Statements of the config about parameters count for the models that have them.
    """
    runs = {}
    with _quantities(config, records).spoken():
        config, study, stand = _read_records(config, folder, records)
        for name, model in models.items():
            other = study.with_model(model.spec)
            declared = {declared.name for declared in declarations_of(model.spec, study.extent)}
            changes = {
                "name": name,
                "model": model,
                "truth": {n: v for n, v in config.truth.items() if n.partition("[")[0] in declared},
            }
            changed = _of_study(config.model_copy(update=changes), other)
            runs[name] = _resolve(changed, other, stand)
    return runs


def _quantities(config: Config, in_memory: Mapping[str, Record]) -> Quantities:
    """Return the quantities of a config's records, before these are read."""
    first, source = next(iter(config.records.items()))
    if first in in_memory:
        return in_memory[first].quantities
    return Quantities.of(source.input, source.output)


def _read_records(
    config: Config, folder: Path, in_memory: Mapping[str, Record]
) -> tuple[Config, Study, VirtualTestStand | None]:
    """Read the records of a config; return its study, and its stand.

    The config says of the joined records what was said of their parts, and while they were read.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        fitted, stand = training_records(config, folder, in_memory)
        require_alike(fitted)
        config, fitted = join_records(config, fitted)
        training, held_out = windows_of(config, fitted)
        validations = validations_of(config, folder, fitted, held_out, in_memory)
    remarks = [text for source in config.records.values() for text in source.remarks or ()]
    remarks += [str(w.message) for w in caught if issubclass(w.category, InputWarning)]
    noted = {
        name: source.model_copy(
            update={"read_as": source.read_as or record_naming(source, fitted[name])}
        )
        for name, source in config.records.items()
    }
    config = _with_remarks(_with_records(config, noted), remarks)
    return config, study_of(config, fitted, training, validations), stand


def _resolve(config: Config, study: Study, stand: VirtualTestStand | None) -> Run:
    """Make a run of a config whose records are read."""
    remarks = []
    if not study.quantities.has_clock:
        study = replace(study, spec=study.spec.without_clock)
        config = config.model_copy(update={"model": config.model.with_spec(study.spec)})
        remarks.append(
            "the record has no time, so it is taken as rate independent: dynamics, creep, stages "
            "that need a clock and the model error's correlation time are left out"
        )
    if config.model.outliers:
        config, study = _without_outliers(config, study)
    require_known("truth", config.truth, study.posterior.table, elsewhere=True)
    actuator = study.posterior.datasets[0].actuator
    remarks += [
        f"loops and step responses leave out what {stage.name} makes of {' and '.join(stage.sees)}"
        for stage in actuator.without_events.stages
        if stage.sees and not stage.rate_independent
    ]
    truth = recoverable(stand, actuator) if stand else {}
    config = _with_remarks(config, remarks)
    return _explicit(config.model_copy(update={"truth": {**truth, **config.truth}}), study)


def with_model(
    run: Run,
    spec: ModelSpec,
    stated: Mapping[str, Stated] | None = None,
    remarks: Sequence[str] = (),
    **keys: object,
) -> Run:
    """Return a run, not begun yet, with another model of the same readings.

    ``stated`` is stated of new parameters, ``remarks`` are added to those of the records, and
    ``keys`` are what [model] says from now on.
    """
    model = run.config.model.model_copy(update=keys)
    config = _with_remarks(run.config.model_copy(update={"model": model}), remarks)
    if spec == run.study.spec and not stated:
        return Run().with_cache(config=config, study=run.study)
    return _explicit(config, run.study.with_model(spec, stated))


def with_noise(run: Run, chosen: str) -> Run:
    """Return a run, not begun yet, whose noise, ``auto``, came to this one.

    As it is, if its config names a noise, or none is chosen yet.
    """
    if run.config.model.noise != "auto" or chosen == "auto":
        return run
    return with_model(run, replace(run.study.spec, noise=chosen), noise=chosen)


def _with_records(config: Config, sources: Mapping[str, RecordConfig]) -> Config:
    """Return a config that says something else of its records."""
    alone = isinstance(config.record, RecordConfig)
    return config.model_copy(update={"record": sources[ALONE] if alone else sources})


def _with_remarks(config: Config, remarks: Sequence[str]) -> Config:
    """Return a config that has further remarks on its records: the first one has all of them."""
    before = [text for source in config.records.values() for text in source.remarks or ()]
    said = [*dict.fromkeys([*before, *remarks])]
    sources = {name: s.model_copy(update={"remarks": None}) for name, s in config.records.items()}
    first = next(iter(sources))
    sources[first] = sources[first].model_copy(update={"remarks": said or None})
    return _with_records(config, sources)


def _without_outliers(config: Config, study: Study) -> tuple[Config, Study]:
    """Leave isolated outliers out of the records whose config does not name them.

    Their ranges would make the default priors, so these are made anew without them.
    """
    suspects = {
        name: isolated_outliers(study.records[name], ends=True)
        for name, source in config.records.items()
        if source.outliers is None
    }
    if not suspects:
        return config, study
    rows = outliers(study, study.generator("outliers"), suspects)
    sources = dict(config.records)
    for name, outlying in rows.items():
        times = study.records[name].time[outlying].tolist()
        sources[name] = sources[name].model_copy(update={"outliers": times})
    return _with_records(config, sources), study.without(rows)


def _explicit(config: Config, study: Study) -> Run:
    """Return the run of a config and its study in explicit numbers; records are files beside it."""
    study, truth = study.explicit, config.truth
    naming = ("columns", "units", "fs", "table", "displacement_file", "covariates")
    as_read = dict.fromkeys(("signal", "voltage_is", "linearity", *naming))
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
    validation = {
        name: v.model_copy(update={"file": f"records/{name}.h5", **as_read}) if v.another else v
        for name, v in config.validation.items()
    }
    true = {p.name: truth.get(p.name, truth.get(p.plain)) for p in study.parameters}
    changes = {
        "model": config.model.with_spec(study.spec),
        "truth": {name: value for name, value in true.items() if value is not None},
        "validation": validation,
    }
    explicit = _of_study(_with_records(config.model_copy(update=changes), records), study)
    run = Run().with_cache(config=explicit, study=study)
    sampling = {"walkers": run.plan.walkers, "engine": study.engine}
    run.config = explicit.model_copy(
        update={"sampling": explicit.sampling.model_copy(update=sampling)}
    )
    return run


def _of_study(config: Config, study: Study) -> Config:
    """Return a config that says of parameters what a study states."""
    scopes = {"per_record": [*study.per_record], "shared": [*study.shared]}
    return config.model_copy(
        update={
            "model": config.model.model_copy(update=scopes),
            "parameters": {
                name: ParameterConfig(**stated.keys) for name, stated in study.stated.items()
            },
        }
    )

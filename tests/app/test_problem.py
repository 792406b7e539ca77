"""A config becomes explicit numbers, once: the same ones from the same config."""

from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes
from bwbayes.app.config.config import parse
from bwbayes.app.fit.fitted import Run
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.study import resolve as resolve_module
from bwbayes.app.study.about import findings_of
from bwbayes.app.study.from_config import windows_of
from bwbayes.app.study.resolve import resolve_config, with_noise
from bwbayes.errors import InputError
from bwbayes.inference.parameters import Parameter
from bwbayes.inference.study import generator
from bwbayes.record import Record, write_record
from bwbayes.record.io import formats
from bwbayes.record.io.fields import record_fields
from tests.app import small
from tests.record.spoilt import SPOILT, looping


def of(text: str, folder: Path) -> Run:
    return resolve_config(parse(text, "my.toml"), folder)


def refused(text: str, folder: Path) -> str:
    with pytest.raises(InputError) as error:
        of(text, folder)
    assert "\n" not in str(error.value)
    return str(error.value)


def record() -> Record:
    voltage, displacement = np.random.default_rng(1).uniform(-1, 1, size=(2, 400))
    return Record(80 * voltage, 50 * displacement + 7, interval=0.01, voltage_is="command")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_record(record(), tmp_path / "record.csv")
    return tmp_path


RECORD = '[record]\nfile = "record.csv"\n'

# A value for every parameter of the default model.
KNOWN = {"d": 0.7, "alpha": 0.35, "beta": 0.03, "gamma": 0.01, "exponent": 1.0, "initial": 0.0}
KNOWN |= {"lag": 0.01, "offset": 0.0, "sensor_sd": 0.5, "discrepancy_sd": 1.0}
KNOWN |= {"discrepancy_time": 0.5}


def by_name(problem: Run) -> dict[str, Parameter]:
    return {parameter.name: parameter for parameter in problem.study.parameters}


def test_each_purpose_and_each_seed_has_a_random_stream_of_its_own() -> None:
    purposes = ("fit", "sampling", "draws", "predict a", "predict b")
    streams = [generator(seed, purpose) for seed in (0, 1, 256) for purpose in purposes]
    assert len(streams) == len({stream.integers(2**62) for stream in streams})
    assert generator(1, "fit").integers(2**62) == generator(1, "fit").integers(2**62)


def test_default_priors_do_not_know_what_is_held_out(tmp_path: Path) -> None:
    text = RECORD + "train = [[0.0, 2.0]]\n[validation.a]\nwindow = [2.0, 4.0]"
    made = record()
    assert made.displacement is not None
    result = []
    for factor in (1.0, 3.0):
        displacement = made.displacement * np.where(np.arange(400) < 200, 1.0, factor)
        write_record(replace(made, displacement=displacement), tmp_path / "record.csv")
        result.append(of(text, tmp_path).study.parameters)
    assert result[0] == result[1]


def test_resolved_config_resolves_to_the_same_numbers(tmp_path: Path) -> None:
    first = resolve_config(small.config(), tmp_path)
    folder = RunFolder.create(tmp_path / "run", first, overwrite=False)
    again = Run(RunFolder.open(folder.path.rename(tmp_path / "moved")))
    assert first.config == again.config
    assert first.study.record.sha256 == again.study.record.sha256
    np.testing.assert_array_equal(first.study.record.truth, again.study.record.truth)
    assert first.study.parameters == again.study.parameters
    assert first.plan == again.plan
    assert (
        first.study.posterior.single_record.training == again.study.posterior.single_record.training
    )
    for name, one in first.study.validations.items():
        other = again.study.validations[name]
        assert (one.windows, one.start) == (other.windows, other.start)
        if one.record is not None and other.record is not None:
            assert one.record.sha256 == other.record.sha256
    z = np.random.default_rng(1).standard_normal((5, first.study.posterior.prior.dimensions))
    np.testing.assert_array_equal(
        first.study.posterior.log_density(z), again.study.posterior.log_density(z)
    )


@pytest.mark.usefixtures("_without_explanations", "_without_pictures")
def test_a_run_resolves_once_and_reads_each_record_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = small.begun(tmp_path / "made")
    calls: Counter[str] = Counter()

    def counted(call: Any, *args: Any, **options: Any) -> Any:
        calls[call.__name__] += 1
        return call(*args, **options)

    for call, module in ((windows_of, resolve_module), (record_fields, formats)):
        monkeypatch.setattr(module, call.__name__, partial(counted, call))
    fit = bwbayes.fit(made.config, folder=tmp_path / "run", workers=1, progress=False)
    assert calls == {"windows_of": 1, "record_fields": 2}
    # Its folder holds the records that were fitted.
    read = bwbayes.open_run(tmp_path / "run")
    for name in ("config", "record_remarks", "facts", "plan"):
        assert getattr(read, name) == getattr(fit, name), name
    for name in ("spec", "stated", "digests", "keys", "defaults", "parameters"):
        assert getattr(read.study, name) == getattr(fit.study, name), name


@pytest.mark.parametrize("train", ["train = [[1.0, 2.0]]\n", ""])
def test_readings_that_count_are_chosen_once_and_the_history_is_kept(
    folder: Path, train: str
) -> None:
    text = RECORD + "start = 1.0\nstop = 3.0\ndecimate = 2\nexclude = [1.5, 1.7]\n" + train
    first = of(text, folder)
    assert (300, 0.01, 0.0) == (
        first.study.record.samples,
        first.study.record.interval,
        first.study.record.start,
    )
    np.testing.assert_array_equal(
        record().voltage[:300], first.study.posterior.single_record.voltage
    )
    assert [*range(100, 150, 2), *range(170, 300, 2)] == np.flatnonzero(
        first.study.record.has_reading
    ).tolist()
    assert (slice(100, 200 if train else 299),) == first.study.posterior.single_record.training
    assert first.facts["record"].endswith("90 readings, none from 0 to 1 s")
    again = Run(RunFolder.create(folder / "run", first, overwrite=False))
    assert (again.study.record.samples, again.study.record.sha256) == (
        300,
        first.study.record.sha256,
    )
    assert (
        again.study.posterior.single_record.training == first.study.posterior.single_record.training
    )
    assert again.study.parameters == first.study.parameters
    assert again.config == first.config


@pytest.mark.parametrize(
    ("voltage_is", "hold"), [("command", "zero"), ("output", "first"), (None, "first")]
)
def test_automatic_hold_follows_what_the_voltage_is(
    folder: Path, voltage_is: str | None, hold: str
) -> None:
    said = "" if voltage_is is None else f"voltage_is = '{voltage_is}'\n"
    rows = (folder / "record.csv").read_text().splitlines()
    silent = [row for row in rows if not row.startswith("#")]
    (folder / "record.csv").write_text("\n".join(silent) + "\n")
    problem = of(RECORD + said, folder)
    assert hold == problem.study.posterior.single_record.actuator.hold
    # Kept as it was asked for: another record has a hold of its own.
    assert problem.config.model.hold == "auto"
    given = of(RECORD + said + "[model]\nhold = 'first'", folder)
    assert "first" == given.study.posterior.single_record.actuator.hold


def test_given_prior_bounds_and_names_replace_the_defaults(folder: Path) -> None:
    text = RECORD + (
        "[parameters.d]\nprior = {distribution = 'normal', mean = 1, sd = 0.1}\nlower = 0.2\n"
        "unit = 'µm/V'\nlabel = 'D'\ndescription = 'gain'\n[parameters.gamma]\nfixed = 0.0"
    )
    result = by_name(of(text, folder))
    d = result["d"]
    assert d.prior is not None
    assert ("normal", {"mean": 1, "sd": 0.1}) == (d.prior.name, dict(d.prior.arguments))
    assert (0.2, np.inf, "µm/V", "D", "gain") == (d.lower, d.upper, d.unit, d.label, d.description)
    assert (0.0, None) == (result["gamma"].fixed, result["gamma"].prior)


def test_nothing_is_said_of_a_record_in_memory_that_stays_as_it_is(tmp_path: Path) -> None:
    marked = np.tile(np.append(-9999.0, np.arange(49.0)), 8)
    in_memory = {"record": replace(record(), displacement=marked)}
    problem = resolve_config(parse(RECORD, "my.toml"), tmp_path, in_memory)
    assert problem.study.record.sha256 == in_memory["record"].sha256
    assert not any("taken as missing" in remark for remark in problem.record_remarks)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("train = [[0.0, 2.0], [1.0, 3.0]]", "overlaps the training window 0 to 2 s"),
        ("start = 3.0\nstop = 2.0", "holds no sample"),
        ("decimate = 1000", "record: displacement: too few readings: 1;"),
        ("start = 1.0\ntrain = [[0.5, 0.9]]", "record.train: no readings from 0.5 to 0.89 s"),
        ("start = 1.0\n[validation.a]\nwindow = [0.0, 0.5]", "a.window: no readings from 0 to"),
        ("outliers = [6.2]", "record.outliers: a time outside of 0 to 4 s"),
        ("[parameters.alfa]\nfixed = 1.0", "alfa: no such parameter here; did you mean alpha?"),
        ("[parameters.mass]\nfixed = 1.0", "parameters.mass: is not in this model; see"),
        ("[parameters.d]\nunit = 'nm/V'", "parameters.d.unit: its numbers are in um/V, not nm/V"),
        ("[parameters]\n" + "\n".join(f"{n} = {{ fixed = {v} }}" for n, v in KNOWN.items()),
         "parameters: all are fixed"),
        ("[model]\ndynamics = 'second-order'", "parameters.mass: has no default prior; give prior"),
        ("[parameters.d]\nprior = {distribution = 'nrmal'}", "parameters.d.prior: nrmal: unknown"),
        ("[parameters.d]\nfixed = -1.0", "d: "),
        ("[validation.a]\nwindow = [1.0, 2.0]", "validation.a.window: 1 to 2 s overlaps"),
        ("[sampling]\nwalkers = 4", "sampling.walkers: 4 are too few"),
        ("[parameters.d]\nprior = { distribution = 'normal', mean = 1e300, sd = 1e299 }",
         "parameters.d: 1e+300 is out of proportion; check its unit"),
    ],
)  # fmt: skip
def test_what_cannot_be_run_is_said_with_its_place(folder: Path, text: str, said: str) -> None:
    assert said in refused(RECORD + text, folder)


@pytest.mark.parametrize(
    ("signal", "said"),
    [
        ("amplitude = 1e-30, frequency = 1.0, duration = 3.0", "voltage: moves by "),
        ("amplitude = 1.0, frequency = 1.0, duration = 1e12", "more than 10,000,000 samples"),
    ],
)
def test_made_record_that_no_file_could_hold_is_refused_before_the_run(
    tmp_path: Path, signal: str, said: str
) -> None:
    assert said in refused(f"[record]\nsignal = {{ {signal} }}", tmp_path)
    held_out = f"[validation.a]\nsignal = {{ {signal} }}\nlead_in = 0.001"
    assert said in refused(f'[record]\nsignal = "identification"\n{held_out}', tmp_path)


def test_what_was_said_of_a_record_stays_with_its_run(folder: Path) -> None:
    text = (folder / "record.csv").read_text().splitlines()
    rows = [f"{line},21.5" for line in text if not line.startswith("#")]
    (folder / "record.csv").write_text("\n".join([rows[0].replace("21.5", "temp_C"), *rows[1:]]))
    first = of(RECORD, folder)
    assert first.record_remarks[0].endswith("ignored columns: temp_C")
    again = Run(RunFolder.create(folder / "run", first, overwrite=False))
    assert first.record_remarks == again.record_remarks


def test_a_model_without_hysteresis_needs_no_loops(tmp_path: Path) -> None:
    voltage = 50 * np.sin(np.arange(4000) / 50)
    error = np.random.default_rng(1).normal(0, 0.005, voltage.size)
    write_record(Record(voltage, 0.1 * voltage + error, interval=1e-3), tmp_path / "record.h5")
    text = '[record]\nfile = "record.h5"\n'
    kinds = [finding.kind for finding in findings_of(of(text, tmp_path).study)["record"]]
    assert ["one amplitude", "no hysteresis"] == kinds
    linear = of(f'{text}[model]\nhysteresis = "linear"\n', tmp_path)
    assert () == findings_of(linear.study)["record"]


def test_findings_of_a_record_are_remarks_where_a_window_looks(tmp_path: Path) -> None:
    transient = SPOILT["switch-on transient"](looping(0), np.random.default_rng(0))
    write_record(transient, tmp_path / "record.h5")
    text = '[record]\nfile = "record.h5"\n'
    whole = of(text, tmp_path)
    (finding,) = findings_of(whole.study)["record"]
    assert f"record: {finding}" in whole.record_remarks
    later = of(f"{text}train = [[{finding.stop + 0.01}, 5.0]]\n", tmp_path)
    assert () == findings_of(later.study)["record"]
    (remark,) = of(
        f"{text}start = {finding.stop}\n[validation.a]\nfile = 'record.h5'", tmp_path
    ).record_remarks
    assert remark.startswith("a: switch-on transient: the displacement starts ")
    assert f". Fix: lead_in_start = {finding.stop:.3g} under [validation.a]" in remark


@pytest.mark.parametrize(
    ("defect", "stage", "foreign"),
    [
        ("drift", "drift", True),
        ("jump", "step", True),
        ("switch-on transient", "transient", True),
        ("late displacement", "delay", False),
        ("reversed sign", "reversed-sign", False),
    ],
)
def test_what_a_stage_takes_into_account_is_no_finding(
    defect: str, stage: str, foreign: bool, tmp_path: Path
) -> None:
    """Its own remedy is said with the stage; another record has an event of its own."""
    write_record(SPOILT[defect](looping(0), np.random.default_rng(0)), tmp_path / "record.h5")
    text = '[record]\nfile = "record.h5"\n[validation.a]\nfile = "record.h5"\n[model]\nstages = '
    for stages, expected in (([], (True, True)), ([stage], (False, foreign))):
        run = of(f"{text}{stages}".replace("'", '"'), tmp_path)
        kinds = [finding.kind for finding in findings_of(run.study)["record"]]
        of_other = any(remark.startswith(f"a: {defect}: ") for remark in run.record_remarks)
        assert (defect in kinds, of_other) == expected


@pytest.mark.parametrize("lead_in", ["4.0", "100.0", "0.001"])
def test_lead_in_that_is_no_part_of_the_record_is_refused_before_sampling(
    tmp_path: Path, lead_in: str
) -> None:
    config = small.config(("from_rest = true", f"lead_in = {lead_in}"))
    with pytest.raises(InputError, match=r"validation\.sine\.lead_in: "):
        resolve_config(config, tmp_path)


def test_seed_makes_the_stands_records_whose_true_values_are_known(tmp_path: Path) -> None:
    def records(seed: int) -> tuple[str | None, ...]:
        problem = resolve_config(small.config(("seed = 3", f"seed = {seed}")), tmp_path)
        assert "zero" == problem.study.posterior.single_record.actuator.hold
        truth = problem.config.truth
        names = ("d", "alpha", "beta", "sensor_sd")
        assert (0.7, 0.3575, 0.0272, 0.5) == tuple(truth[name] for name in names)
        assert "mass" not in truth
        sine = problem.study.validations["sine"].record
        return problem.study.record.sha256, sine.sha256 if sine else None

    assert records(1) == records(1)
    assert not {*records(1)} & {*records(2), None}


def test_with_another_noise_what_is_known_and_said_of_its_parameters_stays(tmp_path: Path) -> None:
    """But for what the other noise has not; what only it has gets its default."""
    before = resolve_config(small.config(), tmp_path)
    discrepancy = {"discrepancy_sd", "discrepancy_time"}
    for noise, gone in (("discrepancy", set()), ("smooth", set()), ("white", discrepancy)):
        after = with_noise(before, noise).config
        assert noise == after.model.noise
        for key in ("truth", "parameters"):
            stated, kept = getattr(before.config, key), getattr(after, key)
            expected = {n: value for n, value in stated.items() if n not in gone}
            assert expected == {n: value for n, value in kept.items() if n in stated}
    assert before.config.truth

"""Noise on a record's voltage: the model is driven without it, the record stays as measured."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.config.config import parse
from bwbayes.app.fit.fitted import VOLTAGE_NOISE, Run
from bwbayes.app.jobs.predict import planned_noise
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError
from bwbayes.inference.study import InitialConditions
from bwbayes.prediction.prediction import predict_record, predict_windows
from bwbayes.record import Record, write_record
from bwbayes.sampling.chain import draws
from tests.app import small
from tests.record.drives import drive

pytestmark = pytest.mark.usefixtures("_without_pictures")

TEXT = (
    '[record]\nfile = "noisy.h5"\n[validation.next]\nfile = "next.h5"\n[model]\nnoise = "white"\n'
)


def noisy_record(seed: int, **options: object) -> Record:
    """Return a record of a straight actuator whose voltage has noise of 0.2% of its range."""
    rng = np.random.default_rng(seed)
    clean = 90 * drive("decaying sine", 500.0, rng)
    measured = clean + 0.18 * rng.standard_normal(clean.size)
    reading = 0.1 * clean + 0.01 * rng.standard_normal(clean.size)
    return Record(measured, reading, interval=0.002, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two records, for reading."""
    path = tmp_path_factory.mktemp("records")
    write_record(noisy_record(1), path / "noisy.h5")
    write_record(noisy_record(2), path / "next.h5")
    return path


@pytest.fixture(scope="module")
def problem(folder: Path) -> Run:
    return resolve_config(parse(TEXT, "my.toml"), folder)


def test_the_model_is_driven_by_the_path_and_the_record_stays_as_measured(problem: Run) -> None:
    record, measured = problem.study.record, noisy_record(1)
    np.testing.assert_array_equal(record.voltage, measured.voltage)
    assert record.sha256 == measured.sha256
    np.testing.assert_array_equal(
        problem.study.posterior.single_record.voltage, record.path.voltage
    )
    assert np.std(record.path.voltage - record.voltage) > 0.1
    said = [remark for remark in problem.record_remarks if "voltage has noise of 0.1" in remark]
    assert [remark.split(":")[0] for remark in said] == ["record", "next"]
    draws = problem.study.posterior.prior.draw(np.random.default_rng(0), 20)
    rng = np.random.default_rng(0)
    (bands,) = predict_windows(problem.study.posterior, draws, record, {"all": slice(0, 5000)}, rng)
    np.testing.assert_array_equal(bands.voltage, record.path.voltage)
    other = noisy_record(2)
    bands = predict_record(
        problem.study.posterior, draws, other, InitialConditions(from_rest=True), rng
    )
    np.testing.assert_array_equal(bands.voltage, other.path.voltage)


def test_a_folder_keeps_the_voltage_as_measured_and_drives_the_model_alike(
    problem: Run, tmp_path: Path
) -> None:
    kept = RunFolder.create(tmp_path / "run", problem, overwrite=False)
    again = Run(RunFolder.open(kept.path))
    np.testing.assert_array_equal(again.study.record.voltage, problem.study.record.voltage)
    np.testing.assert_array_equal(
        again.study.posterior.single_record.voltage, problem.study.posterior.single_record.voltage
    )
    assert again.record_remarks == problem.record_remarks


def test_a_runs_draws_are_wider_by_what_the_path_leaves_unsure(
    folder: Path, tmp_path: Path
) -> None:
    """And a chain from before the voltage's noise was removed is not read."""
    model = 'hysteresis = "linear"\nsearch = "none"\n'
    text = f"{TEXT}{model}[sampling]\ness = 100\nsteps = 200\nblock = 25\n"
    kept = RunFolder.create(tmp_path / "run", resolve_config(parse(text, "my.toml"), folder))
    fit = resume(kept, small.quiet(), workers=1, predict=False)
    posterior, chain = fit.study.posterior, fit.chain
    more = np.array(json.loads(str(chain.attributes()[VOLTAGE_NOISE])))
    column = posterior.names.index("d")
    assert more[column, column] > 0.1 * chain.point.covariance[column, column]
    sampled = draws(posterior, chain).reshape(fit.flat_draws.shape)
    wider = np.var(posterior.prior.unconstrain(fit.flat_draws)[:, column])
    before = np.var(posterior.prior.unconstrain(sampled)[:, column])
    assert wider / before == pytest.approx(
        1 + more[column, column] / chain.point.covariance[column, column], rel=1e-6
    )
    likelihood = posterior.log_likelihood(posterior.prior.theta(sampled[:10]))
    np.testing.assert_allclose(fit.log_likelihood.ravel()[:10], likelihood)
    with np.load(kept.chain / "start.npz") as file:
        arrays = dict(file)
    noted = json.loads(str(arrays["text"]))
    old = json.loads(noted["attributes"]["posterior"])
    del old["voltage of record"]
    noted["attributes"]["posterior"] = json.dumps(old)
    np.savez(kept.chain / "start.npz", allow_pickle=False, **arrays | {"text": json.dumps(noted)})
    with pytest.raises(InputError, match=r"voltage of record was .* start a new run"):
        resume(kept, small.quiet(), workers=1)


def test_noise_on_a_planned_voltage_is_said() -> None:
    record = noisy_record(1)
    planned = replace(record, displacement=None)
    assert "without readings drives the model as it is, with noise of 0.1" in planned_noise(planned)
    for other in (record, replace(planned, voltage_is="command")):
        assert not planned_noise(other)


def test_a_command_is_what_it_says(folder: Path) -> None:
    text = TEXT.replace('"noisy.h5"\n', '"noisy.h5"\nvoltage_is = "command"\n')
    problem = resolve_config(parse(text, "my.toml"), folder)
    np.testing.assert_array_equal(
        problem.study.posterior.single_record.voltage, problem.study.record.voltage
    )
    assert not any(remark.startswith("record: voltage has") for remark in problem.record_remarks)

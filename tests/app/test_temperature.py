"""An actuator that follows a temperature, recorded or not; a voltage with noise drives without it.

The plant is simulated without the stages: the displacement of an actuator, multiplied.
"""

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pytest

import bwbayes as bw
from bwbayes.app.config.config import load, parse
from bwbayes.app.config.keywords import config_of
from bwbayes.app.config.reference import parts_reference
from bwbayes.app.fit.fitted import VOLTAGE_NOISE, Run
from bwbayes.app.jobs.predict import planned_noise
from bwbayes.app.running.explaining import choose_model
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.control.exported import export_model
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate
from bwbayes.inference.study import InitialConditions
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Declaration, normal
from bwbayes.model.inputs import Inputs, Limits
from bwbayes.model.stages.gain import MovingGain, Temperature, TemperatureOffset
from bwbayes.prediction.prediction import predict_record, predict_windows
from bwbayes.record import Record, write_record
from bwbayes.record.io.binary import record_arrays
from bwbayes.sampling.chain import draws
from tests.app import small
from tests.control import cases
from tests.control.compiled import Compiled
from tests.programs import needs
from tests.record.drives import drive

pytestmark = pytest.mark.usefixtures("_without_pictures")

INTERVAL, PER_KELVIN, WIDER, REFERENCE = 0.02, 0.002, 0.005, 22.0
SLOW = np.arange(700) * INTERVAL


def plant(
    voltage: FloatArray, temperature: FloatArray, seed: int, wider: float = 0.0
) -> FloatArray:
    """Return readings (samples,) with 0.1 um of noise of a loop that 15 K make 3% larger.

    Its hysteresis grows by a further part per kelvin.
    """
    actuator = Actuator("none", "first", INTERVAL)
    values = {"d": 0.7, "alpha": 0.3, "beta": 0.04, "gamma": 0.01, "exponent": 1.0}
    values |= {"initial": 0.0, "offset": 0.0}
    theta = np.array([[values[name] for name in actuator.parameters]])
    moved = actuator.displacement(theta, voltage, from_rest=True)[0]
    straight = values["d"] * voltage
    moved = straight + (moved - straight) * (1 + wider * (temperature - REFERENCE))
    noise = 0.1 * np.random.default_rng(seed).standard_normal(voltage.size)
    return np.asarray(3.0 + moved * (1 + PER_KELVIN * (temperature - REFERENCE)) + noise)


def measured(
    low: float, high: float, seed: int, period: float = 1.0, back: bool = False
) -> bw.Record:
    """Return a record along which the temperature goes from low to high, degC, and ``back``."""
    voltage = 80 * np.exp(-0.05 * SLOW) * np.sin(2 * np.pi * SLOW / period)
    temperature = np.linspace(low, high, voltage.size)
    if back:
        temperature = np.concatenate([temperature[::2], temperature[::-2]])
    return bw.Record.from_arrays(
        voltage,
        plant(voltage, temperature, seed, WIDER),
        interval=INTERVAL,
        covariates={"temperature_degC": temperature},
    )


TRAINED = measured(15.0, 30.0, 1)


@pytest.fixture(scope="module")
def fit() -> Any:
    stages = ["temperature", "temperature-width"]
    keys = {"stages": stages, "from_rest": True, "ess": 400, "progress": False}
    with warnings.catch_warnings(record=True) as caught, pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        warnings.simplefilter("always")
        found = bw.fit(TRAINED, dynamics="none", **keys)  # type: ignore[arg-type]
    said = " ".join(str(w.message) for w in caught)
    assert "loops and step responses leave out what temperature makes of temperature_degC" in said
    return found


@pytest.mark.parametrize(
    ("name", "truth"), [("temperature_gain", PER_KELVIN), ("temperature_width", WIDER)]
)
def test_a_coefficient_is_inside_its_interval(fit: Any, name: str, truth: float) -> None:
    """One truth in a hundred is not, and one noise in a hundred shows no such coefficient."""
    found = fit.flat_draws[:, fit.study.posterior.names.index(name)]
    low, high = np.quantile(found, [0.005, 0.995])
    assert low < truth < high
    assert np.std(found) < 0.1 * truth


def covered(bands: Any, record: bw.Record) -> float:
    inside = bands.covers("sensor", 95, record.displacement)
    return float(np.mean(inside[bands.scored_from :]))


def test_a_next_record_at_another_temperature_is_covered(fit: Any) -> None:
    """The twin that is told a wrong temperature is not."""
    other = measured(29.0, 29.5, 2, 1.3)
    wrong = replace(other, covariates={"temperature_degC": np.full(other.samples, 17.0)})
    assert covered(fit.predict(other, from_rest=True), other) > 0.9
    with pytest.warns(bw.InputWarning, match="loop-shaped residuals"):
        assert covered(fit.predict(wrong, from_rest=True), wrong) < 0.5


def test_a_search_finds_both_coefficients() -> None:
    """Where the temperature comes back: one that only rises is a drift of the gain as well."""
    record = measured(15.0, 30.0, 5, back=True)
    config, records = config_of(record, {"dynamics": "none", "from_rest": True})
    chosen = choose_model(resolve_config(config, Path(), records))
    assert chosen.run.config.model.stages == ["temperature-width", "temperature"]


def test_a_temperature_beyond_those_of_training_is_said(fit: Any) -> None:
    with pytest.warns(bw.InputWarning, match="temperature_degC of 38 to 39 exceeds the training"):
        fit.predict(measured(38.0, 39.0, 3), from_rest=True)


@pytest.mark.parametrize(
    "ask",
    [
        lambda fit: fit.predict(replace(TRAINED, covariates={}), from_rest=True),
        lambda fit: fit.predict(signal="step50"),
        lambda fit: fit.predict(signal="step50", after=True),
        lambda fit: fit.compensate("sine", amplitude=20, frequency=1),
        lambda fit: fit.design("d"),
        lambda fit: fit.export(),
        lambda fit: fit.track(),
    ],
)
def test_what_does_not_know_the_temperature_refuses_in_one_line(
    fit: Any, ask: Callable[[Any], Any]
) -> None:
    with pytest.raises(bw.InputError, match=r"temperature_degC.*; ") as refused:
        ask(fit)
    assert "\n" not in str(refused.value)


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_a_command_for_a_temperature_leads_the_plant_there_at_that_temperature(
    fit: Any, tmp_path: Path
) -> None:
    """Within the readings' noise of 0.1 um; at another temperature it does not."""
    at = {"temperature_degC": 28.0}
    shape = {"amplitude": 20.0, "frequency": 0.5, "hold": "foh", "from_rest": True}
    made = fit.compensate("sine", at=at, **shape)
    assert made.summary["conditions"] == at
    command = bw.read_record(made.save(tmp_path)[0], need_displacement=False)
    errors = [
        float(np.sqrt(np.mean((plant(command.voltage, other, 7, WIDER) - 3.0 - made.asked) ** 2)))
        for other in (np.full(command.samples, 28.0), np.full(command.samples, 15.0))
    ]
    assert errors[0] < 0.11
    assert errors[1] > 0.25
    with pytest.raises(bw.InputError, match=r"at: temperature_degC 40 is beyond the 15 to 30 that"):
        fit.compensate("sine", at={"temperature_degC": "40"}, **shape)
    fit.compensate("sine", at={"temperature_degC": "40"}, beyond_training=True, **shape)
    with pytest.raises(bw.InputError, match="temperature-width follows voltage and temperature"):
        fit.export(at=at)


@pytest.mark.parametrize(
    ("at", "said"),
    [
        ({"temperature_degC": "warm"}, "at: temperature_degC is not a finite number; give one"),
        ({"temperature_degC": 20, "load_N": 3}, "at: the model does not follow load_N; leave it"),
    ],
)
def test_conditions_that_cannot_be_are_refused(fit: Any, at: Any, said: str) -> None:
    with pytest.raises(bw.InputError, match=said):
        fit.track(at=at)


def test_a_model_at_a_temperature_is_exported(tmp_path: Path) -> None:
    """The C file is the simulation along a record of that temperature, from where it rests."""
    stages, conditions = (Temperature(), TemperatureOffset()), {"temperature_degC": 31.0}
    plain = replace(cases.actuator("bouc-wen, second-order", "zero"), stages=stages)
    voltage, theta = cases.drive(500), cases.theta(plain)
    made = export_model(
        "bender", replace(plain, conditions=conditions), theta[0], Limits(*cases.SPAN)
    )
    compiled = Compiled(made, tmp_path, needs("cc"))
    assert "It is the model at temperature_degC = 31.0." in made.c_code()
    seen = {"temperature_degC": np.full(voltage.size + 1, 31.0)}
    # From rest at zero volts, and there 0 um.
    inputs = Inputs(np.append(0.0, voltage), interval=plain.interval, covariates=seen)
    moved = plain.displacement(theta, inputs, from_rest=True)[0]
    displacement = compiled.run("forward", 0.0, inputs.voltage)
    np.testing.assert_allclose(displacement, moved - moved[0], rtol=0, atol=1e-12 * np.ptp(moved))
    command = compiled.run("inverse", 0.0, displacement[1:])
    np.testing.assert_allclose(command, inputs.voltage[: command.size], rtol=0, atol=1e-8)


@pytest.mark.usefixtures("_without_explanations")
def test_a_model_that_does_not_see_the_temperature_needs_none() -> None:
    keys = {"stages": [], "noise": "white", "from_rest": True, "ess": 200, "progress": False}
    fit = bw.fit(measured(22.0, 22.01, 4), dynamics="none", **keys)  # type: ignore[arg-type]
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", bw.InputWarning
        )  # other drives are, which is not asked here
        ahead = fit.predict(signal="step50", after=True)
        command = fit.compensate("sine", amplitude=20, frequency=1)
    assert np.isfinite(ahead.mean).all()
    assert np.isfinite(command.voltage).all()


@pytest.mark.parametrize(
    ("said", "shift"), [('["temperature_degC"]', 0.0), ('{ temperature_degC = "T2" }', 1.0)]
)
def test_a_config_names_the_column_of_a_covariate(said: str, shift: float, tmp_path: Path) -> None:
    temperature = TRAINED.covariates["temperature_degC"]
    columns = record_arrays(TRAINED) | {"T2": temperature + 1}
    pd.DataFrame(columns).to_csv(tmp_path / "bench.csv", index=False)
    text = f"[record]\nfile = 'bench.csv'\ncovariates = {said}\n[model]\nstages = ['temperature']"
    (tmp_path / "bench.toml").write_text(text, encoding="utf-8")
    problem = resolve_config(load(tmp_path / "bench.toml"), tmp_path)
    read = problem.study.records["record"]
    np.testing.assert_allclose(read.covariates["temperature_degC"], temperature + shift)
    fixed = {p.name: p.fixed for p in problem.study.posterior.prior.parameters}
    assert fixed["temperature_reference"] == pytest.approx(22.5 + shift)


class Dilated(MovingGain):
    """A gain that follows another covariate, whatever the range of that."""

    sees: ClassVar = ("humidity_percent",)


@pytest.mark.parametrize("stage", ["temperature", "tests.app.test_temperature:Dilated"])
def test_a_model_that_needs_a_covariate_is_refused_without(tmp_path: Path, stage: str) -> None:
    bare = replace(TRAINED, covariates={})
    config, records = config_of(bare, {"stages": [stage]})
    with pytest.raises(bw.InputError, match=r"^\w+: .*, and name its column in covariates"):
        resolve_config(config, tmp_path, records)


class Damp(Temperature):
    """Gain that follows the humidity."""

    name, sees = "damp", ("humidity_percent",)
    parameters = (
        Declaration("damp_gain", "1/percent", "c", "change", lambda _: normal(0.0, 1e-3)),
        Declaration(
            "damp_reference",
            "percent",
            "RH_0",
            "humidity of no change",
            lambda context: context.ranges.middle_of("humidity_percent"),
        ),
    )


def test_default_priors_are_shown_that_follow_any_covariate() -> None:
    said = " ".join(parts_reference("tests.app.test_temperature:Damp").split())
    assert "0.5 s from turn to turn, humidity_percent from 0 to 1); they scale" in said
    assert "damp_reference (percent): humidity of no change of the actuator; fixed at 0.5" in said


# An actuator that heats itself: no temperature is recorded, and the search finds out

SPEED, WARM_UP = 320.0, 6.0  # V/s that heat by 15 K, and s


def heated(frequencies: list[float], seed: int) -> bw.Record:
    """Return a record of sines of 80 V, four seconds of each frequency, Hz, from cold."""
    frequency = np.repeat(frequencies, round(4 / INTERVAL))
    voltage = 80 * np.sin(2 * np.pi * np.cumsum(frequency) * INTERVAL)
    heat = [0.0]
    for moved in np.abs(np.diff(voltage)) / INTERVAL:
        now = heat[-1]
        for _ in range(20):
            now += INTERVAL / 20 / WARM_UP * (moved / SPEED - now)
        heat.append(now)
    reading = plant(voltage, REFERENCE + 15 * np.array(heat), seed)
    return bw.Record(voltage, reading, interval=INTERVAL)


def test_self_heating_is_found_and_carried_to_another_drive() -> None:
    """The twin without it covers less than half, by a band three times as wide."""
    record = heated([2, 0.3, 1, 2, 0.2, 1.5, 0.3], 21)
    config, records = config_of(record, {"dynamics": "none", "from_rest": True})
    problem = resolve_config(config, Path(), records)
    chosen, rng = choose_model(problem), np.random.default_rng(3)
    assert chosen.run.config.model.stages == ["heating"]
    other, found = heated([0.2, 2, 2, 0.3, 2], 22), []
    without = problem.study.posterior, map_estimate.fit(problem.study.posterior, rng)
    for posterior, point in ((chosen.run.study.posterior, chosen.point), without):
        coordinates = rng.multivariate_normal(point.mode, point.covariance, 200)
        draws, density = posterior.prior.constrain(coordinates)
        start = InitialConditions(from_rest=True)
        bands = predict_record(posterior, draws[np.isfinite(density)], other, start, rng)
        scored = slice(bands.scored_from, None)
        width = np.mean((bands.upper["sensor", 95] - bands.lower["sensor", 95])[scored])
        found.append((covered(bands, other), width))
    assert found[0][0] > 0.9
    assert found[1][0] < 0.5
    assert found[0][1] < found[1][1] / 2


# Noise on a record's voltage: the model is driven without it, the record stays as measured


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
    np.savez(kept.chain / "start.npz", **arrays | {"text": json.dumps(noted)})
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

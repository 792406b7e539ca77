"""Unsure instruments widen what depends on them; other quantities have their own units."""

import json
import re
import shutil
import subprocess
import warnings
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import bwbayes as bw
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.model.actuator import Actuator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.prediction.bands import KINDS
from bwbayes.prediction.budget import TYPES
from bwbayes.quantities import Quantities
from bwbayes.record import write_record
from bwbayes.report.report import as_text
from tests.app import small, specimens
from tests.app.conftest import Type
from tests.programs import needs

UNITS = {"displacement": "um +- 2 %", "voltage": "V +- 0.5 %"}
KEYS: dict[str, Any] = {
    "dynamics": "none",
    "noise": "white",
    "stages": [],
    "train": (0.0, 2.0),
    "parameters": {"initial": {"fixed": 0.0}, "gamma": {"fixed": 0.0172}},
    "ess": 300,
    "walkers": 12,
    "block": 20,
    "progress": False,
}


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[bw.Run, bw.Run]:
    """Return fits of one record by exact instruments, and by those that are known to 2 %."""
    folder = tmp_path_factory.mktemp("both")
    write_record(specimens.record(0), folder / "record.csv")
    instruments: dict[str, Any] = {"units": UNITS, "linearity": "0.1 %"}
    with pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        small.without_pictures(patch)
        exact = bw.fit(folder / "record.csv", folder=folder / "exact", **KEYS)
        unsure = bw.fit(folder / "record.csv", folder=folder / "unsure", **instruments, **KEYS)
    return exact, unsure


def test_parameters_are_wider_by_what_their_units_have_of_the_scales(
    both: tuple[bw.Run, bw.Run],
) -> None:
    before, after = (fit.summary for fit in both)
    relative = {"d": np.hypot(0.02, 0.005), "alpha": np.hypot(0.02, 0.005), "beta": 0.005}
    for name, scale in relative.items():
        expected = np.hypot(before.loc[name, "sd"], scale * before.loc[name, "mean"])
        assert expected == pytest.approx(after.loc[name, "sd"], rel=0.03), name
        assert before.loc[name, "mean"] == pytest.approx(after.loc[name, "mean"], rel=1e-3)
    exact, unsure = both
    np.testing.assert_array_equal(exact.flat_draws, unsure.flat_draws)  # as the readings have them
    assert unsure.draws["d"].std() == pytest.approx(after.loc["d", "sd"], rel=1e-3)


def test_bands_loops_and_commands_are_wider_but_for_the_sensor_band(
    both: tuple[bw.Run, bw.Run],
) -> None:
    (before, after), (exact, unsure) = (fit.bands["training"] for fit in both), both
    for edges in ("lower", "upper"):
        np.testing.assert_array_equal(
            getattr(before, edges)["sensor", 95], getattr(after, edges)["sensor", 95]
        )
    for kind in KINDS:
        assert before.sd(kind) == pytest.approx(after.read_sd(kind), rel=1e-5)
    assert np.mean(before.sd("displacement")) < 0.2 * np.mean(after.sd("displacement"))
    assert exact.validation == unsure.validation
    loops = [fit.result.loops for fit in both]
    assert loops[0] is not None
    assert loops[1] is not None
    narrow, wide = (loop.major.estimates["range_um"] for loop in loops if loop)
    assert narrow is not None
    assert wide is not None
    assert np.hypot(narrow.sd, 0.02 * narrow.mean) == pytest.approx(wide.sd, rel=0.03)
    options: dict[str, Any] = {"amplitude": 20.0, "frequency": 1.0, "from_rest": True}
    with warnings.catch_warnings(action="ignore", category=bw.InputWarning):
        promised = [fit.compensate("sine", **options).compensated for fit in (exact, unsure)]
    np.testing.assert_array_equal(promised[0].voltage, promised[1].voltage)
    # The rms of 20 um |s - 1| sin, s known to 2 %, in the mean over s.
    scale = 20 * 0.02 * np.sqrt(2 / np.pi) / np.sqrt(2)
    assert scale < promised[1].rms.mean() < scale + 1.2 * promised[0].rms.mean()


def test_closed_loop_export_and_design_count_the_scales(both: tuple[bw.Run, bw.Run]) -> None:
    exact, unsure = (fit.track(frequencies=(5.0,), draws=50) for fit in both)
    np.testing.assert_array_equal(exact.limited, unsure.limited)  # the controller sees readings
    sine = exact.signals.index("sine")
    errors = [tracking.rms[3, 0, sine].mean() for tracking in (exact, unsure)]
    scale = exact.amplitude * 0.02 * np.sqrt(2 / np.pi) / np.sqrt(2)
    assert scale < errors[1] < scale + 1.2 * errors[0]
    models = [fit.export() for fit in both]
    assert models[1].sds["d"] == pytest.approx(both[1].summary.loc["d", "sd"], rel=0.01)
    means, again = ({n: float(v[0]) for n, v in m.model.column.items()} for m in models)
    assert means == again
    assert "sensor scale known to 2 % (one standard uncertainty)" in models[1].c_code()
    left = [fit.design("d").best.sd_ratio for fit in both]
    before, after = (fit.summary.loc["d", "sd"] for fit in both)
    expected = np.sqrt((left[0] * before) ** 2 + after**2 - before**2) / after
    assert left[1] == pytest.approx(expected, rel=1e-3)
    steady = 20 * np.sin(np.linspace(0, 20, 200))
    left = [fit.design(steady).best.sd_ratio for fit in both]
    assert left[0] < left[1] < 1


def test_run_keeps_its_instruments_and_files_of_its_columns_have_them(
    both: tuple[bw.Run, bw.Run], tmp_path: Path
) -> None:
    again = bw.open_run(both[1].folder.path)
    assert both[1].study.record.instruments == again.study.record.instruments
    assert "known to 2 % (one standard uncertainty)" == again.facts["sensor scale"]
    write_record(specimens.record(1), tmp_path / "next.csv")
    with warnings.catch_warnings(action="ignore", category=bw.InputWarning):
        predicted = again.predict(tmp_path / "next.csv")
    assert predicted.sd("displacement").max() > 0.02 * 0.8 * np.abs(predicted.mean).max()


def test_budget_of_a_run_adds_up_to_what_it_states(both: tuple[bw.Run, bw.Run]) -> None:
    budgets = {budget.name: budget for budget in both[1].budget().budgets}
    listed = json.loads(both[1].folder.summary.read_text())["uncertainty_budget"]
    summary = {budget["quantity"]: budget for budget in listed}
    assert [*budgets] == [*summary]
    for name, budget in budgets.items():
        assert 1 == pytest.approx(sum(budget.shares.values()), rel=1e-9)
        assert budget.shares.keys() <= TYPES.keys()
        assert budget.lower < budget.mean < budget.upper
        total = sum(part["share"] for part in summary[name]["sources"].values())
        assert 1 == pytest.approx(total, rel=1e-9)
    d = both[1].summary.loc["d"]
    assert d["sd"] == pytest.approx(budgets["d"].sd, rel=0.1)
    assert 0.02**2 * d["mean"] ** 2 / budgets["d"].sd ** 2 == pytest.approx(
        budgets["d"].shares["sensor scale"], rel=0.02
    )
    page = (both[1].folder.path / "report.html").read_text(encoding="utf-8")
    assert "Uncertainty budget" in page


def test_certificate_says_what_was_stated_and_found(
    bwbayes: Type, both: tuple[bw.Run, bw.Run], tmp_path: Path
) -> None:
    shutil.copytree(both[1].folder.path, tmp_path / "run")
    config = tmp_path / "run/config.toml"
    text = re.sub(r"\[certificate\]\ninstruments = \[\]\n", "", config.read_text())
    stated = '[certificate]\nobject = "stack <7>"\nconditions = "23 degC"\ninstruments = ["CS1"]\n'
    config.write_text(f"{text}\n{stated}")
    said = bwbayes("certificate", "run")
    assert 0 == said.status
    numbers = json.loads((tmp_path / "run/certificate/certificate.json").read_text())
    found = {quantity["name"]: quantity for quantity in numbers["quantities"]}
    assert found.keys() >= {budget["quantity"] for budget in numbers["uncertainty_budget"]}
    d = both[1].summary.loc["d"]
    assert (d["lower_95"], d["upper_95"]) == pytest.approx(
        (found["d"]["lower_95"], found["d"]["upper_95"]), rel=1e-9
    )
    half = (d["upper_95"] - d["lower_95"]) / 2
    assert half == pytest.approx(found["d"]["expanded_uncertainty"], rel=1e-9)
    assert half / d["sd"] == pytest.approx(found["d"]["coverage_factor"], rel=1e-9)
    assert sha256(config.read_bytes()).hexdigest() == numbers["config.toml, SHA-256"]
    assert both[1].study.sha256 == numbers["data, SHA-256"]
    assert {"stack <7>", "23 degC", "CS1"} <= {*numbers["stated"].values()}
    page = (tmp_path / "run/certificate/certificate.html").read_text(encoding="utf-8")
    for text in ("stack &lt;7&gt;", "dh = α du", "JCGM 101", "for drives like", "known to 2 %"):
        assert text in page
    assert "Standard uncertainty" not in page  # of fewer draws, beside the estimates
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)


def test_certificate_of_exact_instruments_says_so(fit: bw.Run) -> None:
    facts = fit.certificate().stated
    assert "taken as exact: no uncertainty is stated" == facts["sensor scale"]
    assert "not stated" == facts["conditions"]


def test_failed_run_is_stamped(fit: bw.Run) -> None:
    failed = fit.with_cache(standing=ValidationSummary(False, ("held-out: too narrow",)))
    with pytest.warns(bw.InputWarning, match="too narrow"):
        certificate = failed.certificate()
    (stamp,) = certificate.report().banners
    assert ("bad", "VALIDATION FAILED: this is no certificate") == (stamp.kind, stamp.headline)
    assert certificate.limits[0].startswith("none to rely on")


def test_certificate_is_one_printed_page(fit: bw.Run, tmp_path: Path) -> None:
    fit.certificate().save(tmp_path)
    printed = tmp_path / "page.pdf"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-pdf-header-footer"]
    page = (tmp_path / "certificate.html").as_uri()
    command = [needs("chromium"), *options, f"--print-to-pdf={printed}", page]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    assert 1 == len(re.findall(rb"/Type */Page\b", printed.read_bytes()))


# Loops of other quantities: each run by one line, in its own words and units, and back again


# The sds of alpha/d, and of beta and gamma times the amplitude.
ALPHA, BETA, GAMMA = 0.6, 2.5, 1.5


@dataclass(frozen=True)
class Loop:
    """A loop that decays: its quantities, the columns of its file, and what it is made of."""

    input: str
    output: str
    columns: tuple[str, str]
    amplitude: float  # of the input, in its unit
    slope: float  # d, in the output's unit per input's
    factors: tuple[float, float] = (1.0, 1.0)  # of the numbers in the file
    interval: float | None = None

    @property
    def truth(self) -> dict[str, float]:
        """The true parameters, by name."""
        rates = {"beta": BETA / self.amplitude, "gamma": GAMMA / self.amplitude}
        return {"d": self.slope, "alpha": ALPHA * self.slope, **rates}

    def follow(self, driven: FloatArray) -> FloatArray:
        """Return what comes out, from the demagnetized state."""
        actuator = Actuator("none", "first", 1.0, BoucWen())
        values = {"exponent": 1.0, "initial": 0.0, **self.truth}
        theta = np.array([[values.get(d.name, 0.0) for d in actuator.declarations]])
        out: FloatArray = actuator.displacement(theta, driven)[0]
        return out

    def write(self, path: Path) -> None:
        """Write a file with noise of 0.4% of the range."""
        phase = np.linspace(0, 1, 900)
        driven = self.amplitude * np.sin(2 * np.pi * 6 * phase) * (1 - 0.6 * phase)
        out = self.follow(driven)
        out = out + 0.004 * np.ptp(out) * np.random.default_rng(1).standard_normal(out.size)
        numbers: dict[str, Any] = {
            name: series * factor
            for name, series, factor in zip(self.columns, (driven, out), self.factors, strict=True)
        }
        if self.interval is not None:
            numbers = {"time (s)": self.interval * np.arange(out.size), **numbers}
        pd.DataFrame(numbers).to_csv(path, index=False)


LOOPS = {
    "magnet": Loop("H (A/m)", "B (T)", ("H [kA/m]", "B [mT]"), 300.0, 0.004, (1e-3, 1e3)),
    "force": Loop(
        "displacement (mm)", "force (kN)", ("displacement (mm)", "load_N"), 20.0, 0.5, (1.0, 1e3)
    ),
    "ferroelectric": Loop("E (kV/cm)", "P (uC/cm2)", ("E (V/m)", "P"), 40.0, 0.75, (1e5, 1.0)),
    "muscle": Loop(
        "pressure (bar)", "length (mm)", ("pressure_bar", "length_mm"), 3.0, 6.0, interval=0.01
    ),
}
# The package's own words and units.
OWN = re.compile(r"\b([vV]oltages?|[dD]isplacements?|um|µm|V|volts?|piezo\w*)\b(?![=_])")


@pytest.mark.usefixtures("_without_pictures", "_without_explanations")
@pytest.mark.filterwarnings("ignore::bwbayes.errors.InputWarning")  # that a start is smoothed
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ("magnet", "muscle") else pytest.mark.slow)
        for name in LOOPS
    ],
)
def test_a_loop_of_any_quantities_is_run_by_one_line_in_its_own_units(
    name: str, bwbayes: Type
) -> None:
    """Parameters within 4 SDs of the truth (a chance of 2e-4 to fail); commands to 2% of the range.

    Files are in other units than the run, which is told apart by their names alone. One without a
    time and one with it are in the default suite, all with ``-m slow``.
    """
    loop, quantities = LOOPS[name], Quantities.of(LOOPS[name].input, LOOPS[name].output)
    loop.write(Path("loop.csv"))
    stated = ("--input", loop.input, "--output", loop.output)
    said = bwbayes("run", "loop.csv", *stated, "--search", "none", "--workers", 1, "--out", "run")
    assert (said.status, "no time" in said.out) == (0, loop.interval is None), said
    numbers = json.loads(Path("run/summary.json").read_text(encoding="utf-8"))
    unit = {"d": f"{quantities.say('um/V')}", "beta": f"{quantities.say('1/V')}"}
    for parameter, true in loop.truth.items():
        estimate = numbers["parameters"][parameter]
        assert abs(estimate["mean"] - true) < 4 * estimate["sd"]
        assert estimate["unit"] == unit.get(parameter, estimate["unit"])
    timed = {"lag", "discrepancy_time"} & numbers["parameters"].keys()
    assert bool(timed) == (loop.interval is not None)
    fit = bw.open_run("run")
    amplitude, frequency = 0.3 * loop.slope * loop.amplitude, 0.005 / (loop.interval or 1.0)
    compensation = fit.compensate("sine", amplitude=amplitude, frequency=frequency, from_rest=True)
    compensation.save("command")
    exported = fit.export()
    exported.save("exported")
    files = ["run/report.html", "run/bands.csv", "run/summary.json", "exported/model.json"]
    files += ["exported/actuator.c"]
    files += ["command/compensation.html", "command/compensation.csv", "command/command.csv"]
    texts = {file: Path(file).read_text(encoding="utf-8") for file in files}
    texts |= {"screen": said.out, "fit": as_text(fit.full_report())}
    # "displacement" is the package's word for an output; here it may be the input.
    inside = {word.rstrip("s") for word in re.findall(OWN, f"{loop.input} {loop.output}")}
    for place, text in texts.items():
        plain = re.sub(r"<script.*?</script>|<style.*?</style>|data:[^\"]*", "", text, flags=re.S)
        assert {word.lower().rstrip("s") for word in re.findall(OWN, plain)} <= inside, place
    command = bw.read_record("command/command.csv", need_displacement=False)
    assert command.quantities == fit.quantities
    reference, out = compensation.smoothed, loop.follow(command.voltage)
    assert np.max(np.abs(out - reference)) < 0.02 * np.ptp(reference)

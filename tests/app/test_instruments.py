"""What instruments are worth widens what depends on them, and stands in budget and certificate."""

import json
import re
import shutil
import subprocess
import warnings
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.prediction.bands import KINDS
from bwbayes.prediction.budget import TYPES
from bwbayes.record import write_record
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

"""The calibrate command: what it leaves, how it goes on, and the status it ends with."""

import json
import re
import shutil
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

import bwbayes as bw
from bwbayes.app.config.config import parse
from bwbayes.app.jobs.calibrate import resume, start
from bwbayes.app.running.fingerprint import state_of
from bwbayes.app.running.folder import CalibrationFolder, RunFolder
from bwbayes.calibration.calibration import CalibrationSetup
from bwbayes.errors import InputError
from bwbayes.inference.posterior import Posterior
from bwbayes.prediction.bands import KINDS, LEVELS
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Waveform, sine
from bwbayes.sampling.plan import SamplingPlan
from tests.app import small
from tests.app.conftest import Type
from tests.app.specimens import MODEL
from tests.app.steps import Steps
from tests.measured import keep

# A replicate takes a fraction of a second.
TEXT = (
    f"""\
seed = 3
name = "<b>small</b>"

[record]
signal = {{ amplitude = 100.0, frequency = 1.0, duration = 2.0, decay = 0.2 }}
train = [[0.0, 1.5]]

[stand]
sample_rate = 40.0

{MODEL}"""
    + """\
d = { prior = { distribution = "normal", mean = 0.7, sd = 0.05 } }
alpha = { prior = { distribution = "normal", mean = 0.3, sd = 0.05 } }
sensor_sd = { prior = { distribution = "lognormal", median = 0.5, sigma = 0.3 } }

[sampling]
ess = 100
walkers = 12
block = 10
pilot_steps = 30

[validation.end]
window = [1.5, 2.0]

[validation.other]
signal = { amplitude = 60.0, frequency = 2.0, duration = 1.5 }
lead_in = 0.5
"""
)

FILES = ("calibration.json", "calibration.html", "config.toml")


def begun(path: Path, count: int = 3, text: str = TEXT) -> CalibrationFolder:
    return start(parse(text, "small.toml"), path.parent, path, count)


def assert_same_end(expected: Path, got: Path) -> None:
    pictures = [f"figures/{name}.png" for name in ("coverage", "rank_ecdf", "rank_histograms")]
    assert pictures == sorted(f"figures/{path.name}" for path in expected.glob("figures/*"))
    for name in (*FILES, *pictures):
        assert (expected / name).read_bytes() == (got / name).read_bytes(), name
    # Replicates are written in the order in which they are done.
    lines = [(p / "replicates.jsonl").read_bytes().splitlines() for p in (expected, got)]
    assert sorted(lines[0]) == sorted(lines[1])


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a calibration of three replicates, made in one piece by one worker; for reading."""
    path = tmp_path_factory.mktemp("whole") / "a"
    assert resume(begun(path), small.quiet(), workers=1).passed
    return path


def cut(whole: Path, path: Path, size: int) -> CalibrationFolder:
    shutil.copytree(whole, path)
    shutil.rmtree(path / "figures")
    for name in ("calibration.json", "calibration.html"):
        (path / name).unlink()
    (path / "replicates.jsonl").write_bytes((whole / "replicates.jsonl").read_bytes()[:size])
    return CalibrationFolder.open(path)


def line_ends(whole: Path) -> list[int]:
    content = (whole / "replicates.jsonl").read_bytes()
    return [result.end() for result in re.finditer(b"\n", content)]


def test_summary_and_lines_hold_every_replicate(whole: Path) -> None:
    result = json.loads((whole / "calibration.json").read_text())
    assert (True, False, 3, [], 12) == tuple(
        result[key] for key in ("passed", "telling", "replicates", "unconverged", "tests")
    )
    assert 3 == result["seed"]
    assert {"20% too small", "10% too small"} == set(result["power_of_one_smooth_test"])
    first, *lines = (whole / "replicates.jsonl").read_text().splitlines()
    assert 3 == json.loads(first)["replicates"]
    assert [0, 1, 2] == [json.loads(line)["number"] for line in lines]
    own = [f"{kind} {level}" for kind in KINDS for level in LEVELS]
    bands = [*own, *(f"other {name}" for name in own)]
    assert bands == list(result["bands"])
    for line in lines:
        assert bands == list(json.loads(line)["covered"])
    # The folder's config has every prior in numbers, though the record is simulated.
    text = (whole / "config.toml").read_text()
    assert "signal" not in text
    assert 'file = "records/record.h5"' in text
    assert "median = 0.5" in text


def test_page_needs_nothing_else_and_escapes(whole: Path) -> None:
    page = (whole / "calibration.html").read_text(encoding="utf-8")
    assert "<b>small</b>" not in page
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert 3 == page.count("data:image/png;base64,")
    few = "low power: more replicates are needed to detect SDs 20% too small"
    for text in ("&lt;b&gt;small&lt;/b&gt;", "Passed", few, 'class="words">other</td>', "12 tests"):
        assert text in page


@pytest.mark.usefixtures("_without_pictures")
def test_more_replicates_can_be_asked_for(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It tells what share of its figures is drawn."""
    folder = cut(whole, tmp_path / "a", line_ends(whole)[2])
    folder.replicates.write_bytes(folder.replicates.read_bytes().replace(b's":3', b's":2'))
    steps = Steps.of_commands(monkeypatch)
    assert 3 == resume(folder, small.quiet(), workers=1, replicates=3).replicates
    steps.require("figures")
    request, *lines = (whole / "replicates.jsonl").read_bytes().splitlines()
    written = folder.replicates.read_bytes().splitlines()
    assert lines == [line for line in written if b"number" in line]
    assert request in written


def test_request_to_stop_is_answered_with_how_to_go_on(
    bwbayes: Type, whole: Path, tmp_path: Path
) -> None:
    """With two threads it then ends in the same bytes: half a line is made again."""
    (tmp_path / "small.toml").write_text(TEXT)
    command = small.command(
        "calibrate", "small.toml", "--replicates", "3", "--out", "a", "--quiet", "--workers", "1"
    )
    lines = tmp_path / "a/replicates.jsonl"
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    end = time.monotonic() + 120
    while not (lines.exists() and lines.read_bytes().count(b"\n") > 1):
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=120)
    assert (130, "") == (process.returncode, out)
    assert "interrupted; resume with `bwbayes calibrate --resume a`\n" == err
    assert not (tmp_path / "a/calibration.json").exists()
    with lines.open("ab") as file:
        file.write(b'{"number": 2, "ra')  # cut off
    done = bwbayes("calibrate", "--resume", "a", "--workers", "2", "--executor", "threads")
    assert 0 == done.status, done.err
    texts = ("log_likelihood", "loop_area", "95%", "sensor", "power", "3 replicates, 0 not")
    for text in (*texts, "low power: more replicates are needed"):
        assert text in done.out
    assert "judging" in done.err
    assert_same_end(whole, tmp_path / "a")


@pytest.mark.usefixtures("_without_pictures")
def test_unconverged_replicates_are_counted_and_end_with_status_four(
    bwbayes: Type, tmp_path: Path
) -> None:
    (tmp_path / "short.toml").write_text(TEXT.replace("block = 10", "block = 10\nsteps = 10"))
    command = "calibrate", "short.toml", "--replicates", "2", "--out", "a", "--workers", "1"
    said = bwbayes(*command)
    assert 4 == said.status
    assert "CALIBRATION FAILED: 2 of 2 replicates did not converge, more than 1%; see " in said.err
    assert "2 replicates, 2 not converged" in said.out
    result = json.loads((tmp_path / "a/calibration.json").read_text())
    assert (False, [0, 1]) == (result["passed"], result["unconverged"])
    page = (tmp_path / "a/calibration.html").read_text(encoding="utf-8")
    assert "CALIBRATION FAILED" in page
    assert "replicates 0, 1" in page


@pytest.mark.usefixtures("_without_pictures")
def test_run_is_calibrated_in_its_folder_and_its_report_says_so(
    bwbayes: Type, copy: RunFolder
) -> None:
    """Replicates of another run are none of it."""
    command = "calibrate", "copy", "--workers", "1", "--replicates"
    said = bwbayes(*command, 2)
    assert said.status == 0, said.err
    for text in ("2 replicates, 0 not converged", "report: copy/calibration/calibration.html"):
        assert text in said.out
    numbers = json.loads(copy.summary.read_text())["calibration"]
    assert (True, 2, []) == (numbers["passed"], numbers["replicates"], numbers["unconverged"])
    page = (copy.path / "report.html").read_text(encoding="utf-8")
    assert "Calibration: Passed, with too few replicates" in page
    assert "2 records simulated with draws of this posterior" in page
    page = (copy.calibration.path / "calibration.html").read_text(encoding="utf-8")
    assert "draws of the posterior; each record is fitted together with the run" in page
    bwbayes(*command, 2, "--seed", 4).assert_refused("copy: is a run, with its seed and folder")
    state = state_of(bw.open_run(copy.path))
    for path in (copy.calibration.replicates, copy.calibration.summary):
        path.write_text(path.read_text().replace(state, "another"))
    assert bw.open_run(copy.path).calibration is None
    bwbayes(*command, 2).assert_refused("another config or record", "--overwrite")


@pytest.mark.usefixtures("_without_pictures")
def test_run_that_fails_its_calibration_says_so_and_ends_with_status_four(
    bwbayes: Type, copy: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def short(posterior: Posterior, plan: SamplingPlan, **rest: Any) -> CalibrationSetup:
        return CalibrationSetup(posterior, replace(plan, max_steps=25), **rest)

    monkeypatch.setattr("bwbayes.app.jobs.calibrate.CalibrationSetup", short)
    said = bwbayes("calibrate", "copy", "--replicates", 1, "--workers", 1)
    assert said.status == 4
    assert "CALIBRATION FAILED: 1 of 1 replicates did not converge" in said.err
    page = (copy.path / "report.html").read_text(encoding="utf-8")
    assert "Calibration: CALIBRATION FAILED" in page
    fit = bw.open_run(copy.path)
    with pytest.warns(bw.InputWarning, match="calibration failed: 1 of 1 replicates did not"):
        again = fit.calibrate(progress=False)  # as it was made
    assert fit.calibration is not None
    assert (again.passed, again.replicates) == (fit.calibration["passed"], 1)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ((), "give either a CONFIG or --resume"),
        (("small.toml", "--resume", "a"), "give either a CONFIG or --resume"),
        (("--resume", "b"), "b: no calibration here, but something else's folder"),
        (("--resume", "a", "--seed", "1"), "takes no other options"),
        (("small.toml", "--out", "a"), "a: exists; resume with `bwbayes calibrate --resume a`"),
        (("small.toml", "--out", "b", "--overwrite"), "b: is not a calibration's folder"),
    ],
)
def test_wrong_command_line_is_refused(
    bwbayes: Type, tmp_path: Path, arguments: tuple[str, ...], part: str
) -> None:
    (tmp_path / "small.toml").write_text(TEXT)
    begun(tmp_path / "a")
    small.begun(tmp_path / "b")
    bwbayes("calibrate", *arguments).assert_refused(part)


@pytest.mark.parametrize(
    ("number", "old", "new"),
    [
        (1, rb'"replicates":3', b'"replicates":0'),
        (3, rb".*", b"[" * 100_000),
        (3, rb'"ranks": .*}, "covered"', b'"ranks": "many", "covered"'),
        (3, rb'"d": \d+', b'"d": 200'),
        (3, rb'"number": 1', b'"number": 0'),
    ],
)
def test_lines_that_are_no_replicates_of_these_are_refused(
    whole: Path, tmp_path: Path, number: int, old: bytes, new: bytes
) -> None:
    folder = cut(whole, tmp_path / "a", line_ends(whole)[-1])
    lines = folder.replicates.read_bytes().splitlines()
    changed = re.sub(old, lambda _: new, lines[number - 1])
    assert changed != lines[number - 1]
    lines[number - 1] = changed
    folder.replicates.write_bytes(b"".join(line + b"\n" for line in lines))
    line = f":{number}: is not one of these replicates; delete this line"
    with pytest.raises(InputError, match=line):
        resume(folder, small.quiet())


def test_replicates_of_nothing_or_of_another_config_are_refused(
    whole: Path, tmp_path: Path
) -> None:
    folder = cut(whole, tmp_path / "a", 0)
    with pytest.raises(InputError, match="does not say how many replicates were requested"):
        resume(folder, small.quiet())
    folder = cut(whole, tmp_path / "b", line_ends(whole)[1])
    text = folder.config.read_text(encoding="utf-8")
    assert "mean = 0.7" in text
    folder.config.write_text(text.replace("mean = 0.7", "mean = 0.8"), encoding="utf-8")
    with pytest.raises(InputError, match="another config or record"):
        resume(folder, small.quiet())


def test_what_no_replicate_can_use_leaves_no_folder(tmp_path: Path) -> None:
    old, new = "mean = 0.3, sd = 0.05", "mean = 3.0, sd = 0.01"
    assert old in TEXT
    with pytest.raises(InputError, match="hardly any draw has"):
        begun(tmp_path / "a", text=TEXT.replace(old, new))
    assert [] == list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_intervals_of_a_run_are_right_for_its_record() -> None:
    """For 300 readings of the stand, in 200 replicates; their mean has an error of 1%.

    Parameters share their record, and so most of what luck does in it.
    """
    stand = VirtualTestStand(sample_rate=50.0)
    record = stand.run(Waveform(sine(100.0, 1.0), 6.0, decay=0.1), default_rng(1))
    fit = bw.fit(record, dynamics="lag", search="none", progress=False, seed=1)
    found = fit.calibrate(replicates=200, progress=False)
    cover = {name: statistic.covered[95] for name, statistic in found.statistics.items()}
    unconverged = len(found.unconverged)
    keep("calibrated run", {"cover": cover, "replicates": 200, "unconverged": unconverged})
    assert found.passed, found.failures
    assert 0.93 < float(np.mean([*cover.values()])) < 0.97

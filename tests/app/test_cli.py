"""The command line: what it prints and leaves, its status, and what its environment may lack."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from itertools import product
from pathlib import Path

import click
import numpy as np
import pytest

import bwbayes as bw
from bwbayes.app.commands.cli import cli
from bwbayes.app.running.folder import RunFolder
from bwbayes.errors import InputError, InputWarning
from bwbayes.inference.noise import NOISES
from bwbayes.model.nonlinearity import TERMS
from bwbayes.model.registry import DYNAMICS, HYSTERESIS
from bwbayes.prediction.bands import KINDS, LEVELS
from bwbayes.record import Record, read_record, write_record
from tests.app import small
from tests.app.conftest import Type
from tests.examples import ROOT

COMMANDS = (
    "init run resume check simulate predict report calibrate campaign compensate compare design "
    "export track config models"
)

HEADER = "time_s,voltage_V,displacement_um"
ROWS = [f"{i / 100},{5 * (i % 7)},{2 * (i % 7)}" for i in range(60)]
RECORD = '[record]\nfile = "record.csv"\n'


def lines(*rows: str) -> str:
    return "\n".join(rows) + "\n"


def test_help_names_every_command(bwbayes: Type) -> None:
    for arguments in ((), ("--help",), ("-h",)):
        said = bwbayes(*arguments)
        assert (0, "") == (said.status, said.err)
        assert all(f"  {command} " in said.out for command in COMMANDS.split())
    assert re.fullmatch(r"bwbayes, version \d+\.\d+\.\d+\n", bwbayes("--version").out)


def test_help_explains_every_option() -> None:
    for name in COMMANDS.split():
        command = cli.commands[name]
        assert "Example: bwbayes" in str(command.help)
        for option in command.params:
            if isinstance(option, click.Option):
                assert (option.help or "").endswith("."), f"{name} {option.opts}"


@pytest.mark.parametrize("command", ["models", "compare"])
def test_help_lists_every_part_of_a_model(bwbayes: Type, command: str) -> None:
    # A long name may go on in the next line, after its hyphen.
    said = re.sub(r"-\n\s+", "-", bwbayes(command, "--help").out)
    words = set(re.split(r"[,\s]+", said))
    assert {*HYSTERESIS, *TERMS, *DYNAMICS, *NOISES, "creep"} <= words


@pytest.mark.parametrize(
    ("typed", "text"),
    [
        ("frobnicate", "No such command 'frobnicate'"),
        ("run", "run: give either CONFIG, or --voltage FILE and --displacement FILE"),
        ("init a.csv --voltage b.csv", "init: give either RECORD, or --voltage"),
        ("run a.toml --bogus", "No such option"),
        ("run a.toml --seed 99999999999999999999", "--seed"),
        ("check a.toml", "a.toml: No such file"),
        ("resume none", "none: no run here; start one with"),
        ("predict none", "give either a record or a signal"),
        ("predict none --signal step10 --record a.csv", "either"),
        ("compensate none", "give either a shape or --reference"),
        ("design none", "give either a parameter or a drive"),
        ("simulate a.xyz", "unknown suffix '.xyz'"),
        ("simulate none/a.csv", "none/a.csv: cannot be written"),
        ("simulate a.csv --signal verificaton", "did you mean 'verification'?"),
        ("simulate a.csv --amplitude 20", "need --signal sine"),
        ("simulate a.csv --signal sine --frequency 600", "sample faster"),
    ],
)
def test_wrong_command_line_is_one_line(
    bwbayes: Type, tmp_path: Path, typed: str, text: str
) -> None:
    bwbayes(*typed.split()).assert_refused(text)
    assert [] == list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("config", "record", "texts"),
    [
        # One of each kind; tests/record and test_config.py have them all.
        (RECORD, [*ROWS[:5], "0.05,abc,1", *ROWS[6:]], ["record.csv:7: voltage_V: ", "abc", ";"]),
        (RECORD, [*ROWS[:20], *ROWS[25:]], ["record.csv:22: time_s: ", "0.06", ";"]),
        ("[record", ROWS, ["invalid TOML"]),
        (RECORD + "[sampling]\nwalkers = 4", ROWS, ["sampling.walkers: 4 are too few"]),
        (RECORD + "[validation.a]\nwindow = [0.1, 0.2]", ROWS, ["overlaps"]),
        ('[record]\nfile = "none.csv"', ROWS, ["none.csv: does not exist"]),
    ],
)
def test_malformed_input_is_one_line_and_leaves_nothing(
    bwbayes: Type, tmp_path: Path, config: str, record: list[str], texts: list[str]
) -> None:
    (tmp_path / "record.csv").write_text(lines(HEADER, *record))
    (tmp_path / "my.toml").write_text(config)
    for command in ("run", "check"):
        bwbayes(command, "my.toml").assert_refused(*texts)
    assert {"record.csv", "my.toml"} == {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("name", ["README.md", "LICENSE"])
def test_a_text_that_is_neither_config_nor_record_is_called_so(
    bwbayes: Type, tmp_path: Path, name: str
) -> None:
    """Examples of configs and tables may be in it."""
    example = f"\n```toml\n{RECORD}```\n[record]: a link\n"
    (tmp_path / name).write_text((ROOT / name).read_text(encoding="utf-8") + example)
    for command in ("run", "check"):
        bwbayes(command, name).assert_refused(f"{name}: is no config, and no record; a config has")


@pytest.mark.usefixtures("_without_explanations")
def test_check_shows_record_priors_and_point_fit_and_writes_its_page_alone(
    bwbayes: Type, tmp_path: Path
) -> None:
    (tmp_path / "small.toml").write_text(small.TEXT)
    said = bwbayes("check", "small.toml")
    assert (0, "") == (said.status, small.without_progress(said.err))
    assert "300 samples every 0.02 s" in said.out
    for name in ("alpha", "discrepancy_time", "lognormal(median", "fixed at 0.0172"):
        assert name in said.out
    assert "No issues found" in said.out
    page = tmp_path / "results" / "small-check" / "check.html"
    assert f"report: {page.relative_to(tmp_path)}" in said.out
    assert {"small.toml", "results"} == {path.name for path in tmp_path.iterdir()}
    assert 0 == bwbayes("simulate", "a.csv", "--rate", "50", "--signal", "step50").status
    bwbayes("check", "small.toml", "--record", "none.csv").assert_refused("none.csv")
    assert "550 samples" in bwbayes("check", "small.toml", "--record", "a.csv").out


@pytest.mark.parametrize("suffix", ["csv", "mat"])
def test_simulate_writes_record_and_truth(bwbayes: Type, tmp_path: Path, suffix: str) -> None:
    said = bwbayes("simulate", f"a.{suffix}", "--signal", "sine", "--duration", "4", "--rate", "50")
    assert (0, "") == (said.status, said.err)
    expected = [f"a.{suffix}", *["a.truth.csv"] * (suffix == "csv"), "a.truth.json"]
    assert [f"wrote {name}" for name in expected] == said.out.splitlines()
    assert set(expected) == {path.name for path in tmp_path.iterdir()}
    result = read_record(tmp_path / f"a.{suffix}")
    assert (200, "command") == (result.samples, result.voltage_is)
    assert result.truth is not None
    assert result.displacement is not None
    assert np.std(result.displacement - result.truth) < 1  # the sensor's noise
    assert 0.3575 == json.loads((tmp_path / "a.truth.json").read_text())["alpha"]


def columns(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open() as file:
        header = next(csv.reader(file))
    return header, np.loadtxt(path, delimiter=",", skiprows=1)


BANDS = {f"{k}_{edge}_{n}_um" for k in KINDS for n in LEVELS for edge in ("lower", "upper")}


def test_predict_writes_the_bands_of_a_signal(bwbayes: Type, run: Path, tmp_path: Path) -> None:
    """From rest, and as what follows on the training record."""
    predict = "predict", run, "--signal", "step50"
    said = bwbayes(*predict, "--from-rest", "--out", "new/bands.csv")
    assert 0 == said.status
    # A step is faster than the sine that was fitted.
    assert "V/s of training; the bands extrapolate" in said.out
    assert "wrote new/bands.csv" in said.out
    header, rows = columns(tmp_path / "new/bands.csv")
    assert ["time_s", "voltage_V", "mean_um"] == header[:3]
    assert set(header[3:]) == BANDS
    assert (550, 21) == rows.shape
    assert np.isfinite(rows).all()
    assert 0 == bwbayes(*predict, "--after", "--out", "bands.csv").status
    fitted, (_, rows) = read_record(run / "records/record.h5"), columns(tmp_path / "bands.csv")
    assert rows[0, 0] == pytest.approx(fitted.start + fitted.duration)
    assert 550 == len(rows)
    bwbayes(*predict, "--after", "--window", "1", "2").assert_refused("a window is for a record")


@pytest.mark.parametrize(
    ("volts", "note"), [(50, ""), (500, "note: voltage -500 to 500 V exceeds the training range -")]
)
def test_predict_takes_a_voltage_alone(
    bwbayes: Type, run: Path, tmp_path: Path, volts: float, note: str
) -> None:
    """And says where it leaves what was fitted; there are no readings to go on from."""
    rows = [f"{i / 100},{volts * np.sin(i / 30)}" for i in range(300)]
    (tmp_path / "plan.csv").write_text(lines("time_s,voltage_V", *rows))
    said = bwbayes("predict", run, "--record", "plan.csv", "--out", "bands.csv")
    assert "starts at 0 V, perhaps from rest: the 95% sensor band" in " ".join(said.out.split())
    assert 0 == said.status
    assert "Coverage" not in said.out
    assert ["time_s", "voltage_V", "mean_um"] == columns(tmp_path / "bands.csv")[0][:3]
    assert note in said.out
    assert ("; the bands extrapolate" in said.out) == bool(note)
    said = bwbayes("predict", run, "--record", "plan.csv", "--after", "--out", "none.csv")
    said.assert_refused("has no readings after which a forecast could start")
    assert not (tmp_path / "none.csv").exists()


def test_no_file_is_replaced_unless_that_is_asked_for(
    bwbayes: Type, run: Path, tmp_path: Path
) -> None:
    (tmp_path / "new.csv").write_text(lines(HEADER, *ROWS))
    before = (tmp_path / "new.csv").read_bytes()
    for command in (
        ("simulate", "new.csv"),
        ("predict", run, "--record", "new.csv", "--lead-in", "0.2", "--out", "new.csv"),
    ):
        bwbayes(*command).assert_refused("new.csv: exists; choose another name, or give `--over")
        assert before == (tmp_path / "new.csv").read_bytes()
    assert 0 == bwbayes("simulate", "new.csv", "--rate", "100", "--overwrite").status
    assert before != (tmp_path / "new.csv").read_bytes()
    (tmp_path / "new.csv").unlink()
    bwbayes("simulate", "new.csv").assert_refused("new.truth.csv: exists")


def test_existing_run_is_kept_with_a_hint(bwbayes: Type, tmp_path: Path) -> None:
    """An impossible target and a damaged chain leave it as it is, too."""
    (tmp_path / "small.toml").write_text(small.TEXT)
    folder = small.begun(tmp_path / "results/small")
    before = folder.config.read_bytes()
    hint = "exists; resume with `bwbayes resume results/small`"
    bwbayes("run", "small.toml").assert_refused(hint, "--overwrite")
    unfinished = "not finished; resume with `bwbayes resume"
    bwbayes("report", "results/small").assert_refused(unfinished)
    bwbayes("predict", "results/small", "--signal", "step10").assert_refused("chain")
    for ess in ("nan", "inf"):
        bwbayes("resume", "results/small", "--ess", ess).assert_refused("ess")
    folder.chain.mkdir()
    (folder.chain / "start.npz").write_bytes(b"PK" + bytes(1000))
    bwbayes("resume", "results/small").assert_refused("chain: the chain cannot be read")
    assert before == folder.config.read_bytes()


@pytest.fixture
def record(run: Path) -> Record:
    return read_record(run / "records/sine.h5")


def test_scores_and_a_picture_lie_beside_the_bands(
    bwbayes: Type, run: Path, record: Record, tmp_path: Path
) -> None:
    write_record(record, tmp_path / "sine.h5")
    predict = "predict", run, "--record", "sine.h5", "--from-rest", "--out"
    assert 0 == bwbayes(*predict, "new/bands.csv", "--window", 2.0, 3.5).status
    bands = tmp_path / "new/bands.csv"
    result = json.loads(bands.with_suffix(".json").read_text())
    assert (2.0, 3.5) == pytest.approx((result["from_s"], result["to_s"]))
    assert 75 == result["samples"]
    assert 0 < result["scores"]["nrmse"]
    assert result["passed"] in (True, None)
    assert bands.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    bands.unlink()
    bwbayes(*predict, "new/bands.csv").assert_refused("bands.json: exists", "give `--overwrite`")
    assert not bands.exists()
    bwbayes(*predict, "bands.png").assert_refused("give a name that ends in .csv")


def test_record_that_goes_the_other_way_ends_with_status_3(
    bwbayes: Type, run: Path, record: Record, tmp_path: Path
) -> None:
    assert record.displacement is not None
    write_record(replace(record, displacement=-record.displacement), tmp_path / "turned.h5")
    said = bwbayes("predict", run, "--record", "turned.h5", "--from-rest", "--out", "bands.csv")
    assert 3 == said.status
    assert said.out.startswith(
        "VALIDATION FAILED: turned (separate record): the readings fall where the voltage rises"
    )
    assert "Likely cause: reversed sign of the displacement. Fix: change" in said.out
    result = json.loads((tmp_path / "bands.json").read_text())
    assert (False, "sign") == (result["passed"], result["cause"])


def test_the_command_to_copy_has_the_options_that_were_given(bwbayes: Type, tmp_path: Path) -> None:
    path = tmp_path / "bench 3.csv"
    path.write_text(lines("amp,laser", *(row.partition(",")[2] for row in ROWS)))
    given = ("--fs", "200", "--out", "my results", "--seed", "3", "--search", "9s")
    said = bwbayes("run", str(path), "--column", "voltage=amp", *given).err
    begin = f"copy and correct: bwbayes run '{path}' --out 'my results' --seed 3 --search 9s "
    assert begin in said
    assert "--column voltage=amp" in said
    assert said.rstrip().endswith("--fs 200")


def test_a_predicted_files_name_need_not_be_utf_8(bwbayes: Type, run: Path, tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/messung_\xe4.csv"))
    write_record(read_record(run / "records/sine.h5"), path)
    out = tmp_path / "bands.csv"
    assert bwbayes("predict", run, "--record", path, "--out", out).status in (0, 3, 5)
    assert out.with_suffix(".png").exists()


def test_a_files_name_need_not_be_utf_8(bwbayes: Type, tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/messung_\xe4.csv"))
    path.write_text(lines(HEADER, *ROWS))
    config = tmp_path / "a.toml"
    assert bwbayes("init", str(path), "--out", str(config)).status == 0
    assert r"messung_\\xe4.csv" in config.read_text(encoding="utf-8")
    assert len(ROWS) == read_record(tmp_path / r"messung_\xe4.csv").samples


# Nothing that the environment lacks ends in a traceback: encodings, readers, processes, caches


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )


MU = "\N{GREEK SMALL LETTER MU}"


@pytest.mark.parametrize(
    ("encoding", "arguments", "status"), [("gbk", ["models"], 0), ("ascii", ["run", MU], 2)]
)
def test_text_goes_to_a_stream_of_any_encoding(
    encoding: str, arguments: list[str], status: int
) -> None:
    ended = python("-m", "bwbayes", *arguments, PYTHONIOENCODING=encoding)
    assert ended.returncode == status
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("stream", ["| true", ">&-"])
def test_a_reader_that_has_gone_is_no_error(stream: str) -> None:
    command = f"{sys.executable} -m bwbayes models {stream}"
    ended = subprocess.run(["sh", "-c", command], capture_output=True, check=False)
    assert ended.stderr == b""


@pytest.mark.parametrize("command", [["models"], ["export", "copy", "--quiet"]])
def test_what_nobody_reads_ends_as_a_broken_pipe_does(copy: RunFolder, command: list[str]) -> None:
    """With 128 + SIGPIPE and no word; what prints nothing comes to its own end."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write) as closed:
        ended = subprocess.run(
            [sys.executable, "-m", "bwbayes", *command],
            cwd=copy.path.parent, stdout=closed, stderr=subprocess.PIPE, check=False,
        )  # fmt: skip
    assert ended.returncode == (0 if "--quiet" in command else 141)
    assert ended.stderr == b""


@pytest.mark.usefixtures("_without_pictures", "_without_explanations")
def test_a_run_behind_head_is_resumed(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(small.TEXT)
    (tmp_path / "blank.py").write_text(small.BLANK)
    command = f"{sys.executable} blank.py run small.toml --out run --workers 1 | head -n 1"
    ended = subprocess.run(
        ["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "rror" not in ended.stderr
    assert len(ended.stdout.splitlines()) == 1
    assert bw.resume(tmp_path / "run", progress=False).converged


def test_numba_may_be_switched_off() -> None:
    script = "from bwbayes.inference import resolve_engine; print(resolve_engine())"
    assert python("-c", script, NUMBA_DISABLE_JIT="1").stdout == "numpy\n"
    script = script.replace("resolve_engine()", "resolve_engine('numba')")
    assert "NUMBA_DISABLE_JIT is set" in python("-c", script, NUMBA_DISABLE_JIT="1").stderr


def test_without_a_place_for_a_cache_functions_are_compiled_all_the_same() -> None:
    script = """
import numba.core.caching as caching
for locator in caching.CacheImpl._locator_classes:
    locator.from_function = classmethod(lambda *_: None)
from bwbayes.inference.compiled.lanes import compile_cached
for number in range(2):
    assert compile_cached()(lambda x: x + 1)(number) == number + 1
"""
    ended = python("-c", script)
    assert ended.returncode == 0, ended.stderr
    assert "no cache can be written" in ended.stderr


OUTER = """
from bwbayes.inference.compiled.lanes import compile_cached
from bwbayes.model.inner import inner

@compile_cached()
def outer():
    return inner()
"""
INNER = """
from bwbayes.inference.compiled.lanes import compile_cached

@compile_cached()
def inner():
    return {}
"""


def test_what_is_compiled_of_other_sources_is_not_taken(tmp_path: Path) -> None:
    """Only a called function has changed, which numba does not look at; else the cache is taken."""
    package = tmp_path / "bwbayes"
    shutil.copytree(Path(bw.__file__).parent, package, ignore=shutil.ignore_patterns("*cache*__"))
    (package / "inference" / "compiled" / "outer.py").write_text(OUTER)
    (tmp_path / "script.py").write_text("""
from bwbayes.inference.compiled.outer import outer
print(outer(), sum(outer.stats.cache_hits.values()))
""")
    for value, hits in ((1, 0), (1, 1), (20, 0)):
        (package / "model" / "inner.py").write_text(INNER.format(value))
        ended = python(str(tmp_path / "script.py"))
        assert ended.stdout == f"{value} {hits}\n", ended.stderr


WORK = """
from bwbayes.app.running.workers import open_executor
{broken}
with open_executor(2) as pool:
    print(pool.submit(abs, -3).result())
"""
NO_SEMAPHORES = """
import multiprocessing.synchronize
def refuse(*_, **__):
    raise OSError(38, "Function not implemented")
multiprocessing.synchronize.SemLock.__init__ = refuse
"""


@pytest.mark.parametrize("broken", ["", NO_SEMAPHORES])
def test_where_no_process_starts_this_one_computes(tmp_path: Path, broken: str) -> None:
    script = tmp_path / "script.py"
    script.write_text(WORK.format(broken=broken))
    ended = python(str(script))
    assert (ended.returncode, ended.stdout) == (0, "3\n"), ended.stderr
    assert ended.stderr.count("no worker process starts") == 1
    assert "Traceback" not in ended.stderr


@pytest.mark.usefixtures("_without_pictures", "_without_explanations")
@pytest.mark.parametrize(
    ("file", "share"),
    [
        *product(["result.npz", "chain.h5", "posterior.nc"], [0.0, 0.5]),
        *product(["chain/start.npz", "chain/sampling-0001.npz"], [0.5]),
        pytest.param("chain/start.npz", 0.0, marks=pytest.mark.slow),
        pytest.param("chain/sampling-0001.npz", 0.0, marks=pytest.mark.slow),
    ],
)
def test_a_run_of_which_a_file_is_cut_off_is_resumed_to_its_end(
    copy: RunFolder, file: str, share: float
) -> None:
    whole = (copy.path / file).read_bytes()
    (copy.path / file).write_bytes(whole[: int(share * len(whole))])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # the chain is damaged
        if file == "chain/start.npz":
            with pytest.raises(InputError, match=r"chain cannot be read .*; delete it"):
                bw.resume(copy.path, progress=False)
            shutil.rmtree(copy.chain)
        assert bw.resume(copy.path, progress=False).converged
    assert copy.numbers()


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("file", ["records/record.h5", "config.toml"])
def test_what_a_run_is_about_is_not_made_up(copy: RunFolder, file: str, share: float) -> None:
    whole = (copy.path / file).read_bytes()
    (copy.path / file).write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=re.escape(str(copy.path / file))):
        bw.resume(copy.path, progress=False)


@pytest.mark.parametrize("text", ["", "{", '{"a": 1', "[]", "\0"])
def test_a_summary_that_is_cut_off_is_not_finished(tmp_path: Path, text: str) -> None:
    folder = RunFolder(tmp_path)
    folder.summary.write_text(text)
    with pytest.raises(InputError, match="is not finished; resume with"):
        folder.require_finished()

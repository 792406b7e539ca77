"""The commands that README and help texts show, and what they need to run: short stand-ins.

An example names files that a reader has: his record, his config, a run that has ended. Here they
are made under these names, small enough for seconds, by what the names look like. So a new example
is run by itself, unless its files are of a new kind.
"""

import fnmatch
import json
import re
import shlex
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.figure import Figure

from bwbayes.app.commands import cli
from bwbayes.record import Record, write_record
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Waveform, sine, staircase
from bwbayes.report.figures import picture_of
from bwbayes.report.result import NO_PLOTS
from tests.app import small
from tests.app.specimens import CONFIG, record as specimen, specimens

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")

# Keys added to a reader's config, so that it takes seconds.
QUICK = "\n[sampling]\ness = 200\nblock = 25\nwalkers = 32\n"

# Keys added to the small config of a campaign, to be a reader's own.
RECORD = '[record]\nfile = "my_record.csv"\ntrain = [[0.0, 2.0]]'
HELD_OUT = "\n[validation.held_out]\nwindow = [2.0, 2.5]\n"

# Words that take minutes or hours, and those run in their place; the rest of a line is as shown.
SHORTER = {
    "--replicates 500": "--replicates 2",
    "--replicates 1000": "--replicates 2",
    "; maxwell-slip + quadratic": "; maxwell-slip(thresholds=2)",
    "ess = 4000": "ess = 400",
    "--frequency 1 --frequency 10": "--frequency 10",
}

# So are what a command does by default, and its options: pictures are blank, pages have no plots,
# no stage of others is tried, models and simulated actuators are few.
DEFAULTS = {
    "bwbayes.app.running.explaining.explain": lambda *_, **__: (),
    "bwbayes.report.figures.plots_of": lambda _: NO_PLOTS,
    "bwbayes.report.figures.draw_kind": lambda *_: Figure(),
    "bwbayes.report.result.picture_of": lambda *_: picture_of(Figure),
    "bwbayes.app.fit.calls.USUAL_MODELS": "linear; bouc-wen",
}
OPTIONS = {"track": {"draws": 5, "frequencies": [2.0]}, "compare": {"future": False}}

# Where a command writes unless --out says where, and the files there. {0} and {1} are its first
# words, {stem} is the first one's name, {record} that of what is predicted.
LEAVES = {
    "run": ("results/{stem}", "report.html summary.json bands.csv posterior.nc chain/start.npz"),
    "resume": ("{0}", "report.html summary.json bands.csv posterior.nc"),
    "report": ("{0}", "report.html figures/corner.png"),
    "check": ("results/{stem}-check", "check.html"),
    "init": ("", "{stem}.toml"),
    "simulate": ("", "{0}"),
    "predict": ("{0}/predictions", "{record}.csv {record}.json {record}.png"),
    "calibrate": ("results/{stem}-calibration", "calibration.html calibration.json"),
    "campaign": ("results/{stem}", "campaign.html campaign.csv campaign.json"),
    "compare": ("results/*comparison", "comparison.html comparison.json comparison.csv"),
    "compensate": ("{0}/compensation/*", "command.csv compensation.csv compensation.html"),
    "export": ("{0}/export", "actuator.c model.json"),
    "budget": ("{0}/budget", "budget.html budget.json"),
    "certificate": ("{0}/certificate", "certificate.html certificate.json"),
    "track": ("{0}/track", "track.html track.csv track.json track.png"),
    "design": ("{0}/design", "design.html design.json best.csv"),
    "config": ("", ""),
    "models": ("", ""),
}


def guides() -> dict[str, str]:
    """Return what the notebooks say between their cells, by their names."""
    return {
        path.stem: "\n".join(
            "".join(cell["source"])
            for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]
            if cell["cell_type"] == "markdown"
        )
        for path in sorted((ROOT / "notebooks").glob("*.ipynb"))
    }


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def lines_of_shell() -> dict[str, str]:
    """Return all command lines that people are shown, and where; the help texts' come first."""
    result: dict[str, str] = {}
    for name, command in cli.cli.commands.items():
        examples = re.findall(r"Example: (bwbayes .*)", command.help or "")
        assert examples, f"the help of {name} has no example"
        result |= {line.strip(): f"{name} --help" for line in examples}
    for where, text in {"README": README, **guides()}.items():
        lines = [line for part in blocks("sh", text) for line in part.splitlines()]
        # Between backquotes too, where more than a name is given.
        lines += re.findall(r"`(bwbayes [^\s`]+ [^`]+)`", text)
        for line in lines:
            result.setdefault(line.partition("#")[0].strip(), where)
    return result


def _measured(name: str) -> Record:
    """Return a reader's record of that name: 37 s at 25 readings a second, or a short step."""
    stand = VirtualTestStand(discrepancy="none", sample_rate=25.0)
    if name.startswith("step"):
        drive = Waveform(staircase((10.0,), 5.0), 6.0, start=1.0)
    else:
        drive = Waveform(sine(100.0, 0.8), 37.0, decay=0.025)
    generator = np.random.default_rng(list(name.encode()))
    return replace(stand.run(drive, generator), truth=None)


def records_of(config: str, folder: Path) -> None:
    """Write the records that a config names; NAME_part_2 is what NAME goes on with."""
    names = set(re.findall(r'file = "([^"]+)"', config))
    for name in names:
        whole, part = re.fullmatch(r"(.*?)(_part_2)?\.csv", name).groups()  # type: ignore[union-attr]
        record = _measured(whole)
        middle = record.start + record.duration / 2
        if part:
            record = record.window(middle, record.start + record.duration)
        elif f"{whole}_part_2.csv" in names:
            record = record.window(record.start, middle)
        write_record(record, folder / name)


def with_files(line: str, folder: Path, run: Path) -> None:
    """Make the files that a command line names in a folder; ``run`` is one that has ended."""
    words = shlex.split(line)
    unit = re.search(r"--unit displacement=nm", line)
    for before, word in pairwise(words[1:]):
        path = folder / word
        path.parent.mkdir(parents=True, exist_ok=True)
        if before in ("--out", "simulate"):
            continue
        if word == "runs/measured_stack.toml" or word.endswith("stack.csv"):
            shutil.copy(ROOT / word, path)
        elif word == "runs/calibration.toml":
            text = (ROOT / word).read_text(encoding="utf-8")
            path.write_text(text.replace("ess = 1000", "ess = 200"), encoding="utf-8")
        elif word.startswith("runs/"):
            path.write_text(small.TEXT, encoding="utf-8")
        elif word.startswith("results/"):
            shutil.copytree(run, path)
        elif word.endswith("/"):
            specimens(path, 3)
        elif word.endswith(".toml"):
            config = CONFIG.replace("[record]", RECORD).replace("walkers = 12", "walkers = 30")
            path.write_text(config + HELD_OUT, encoding="utf-8")
            write_record(specimen(0), path.with_name("my_record.csv"))
        elif word.endswith(".csv"):
            record = _measured(path.stem)
            write_record(record, path)
            if unit and record.displacement is not None:
                write_record(replace(record, displacement=1e3 * record.displacement), path)
                path.write_text(path.read_text().replace("displacement_um", "displacement"))


def shorter(text: str) -> str:
    for long, short in SHORTER.items():
        text = text.replace(long, short)
    return text


def typed(line: str) -> str:
    """Run a command line in this folder, and return what it says.

    It ends with status 0, and leaves its files.

    In this process, as on a machine with one core.
    """
    _, name, *arguments = shlex.split(shorter(line))
    before = _changes()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.cpu_count", lambda: 1)
        for what, instead in DEFAULTS.items():
            patch.setattr(what, instead)
        done = CliRunner().invoke(
            cli.cli, [name, *arguments], standalone_mode=False, default_map=OPTIONS
        )
    assert done.exception is None, f"{line}: {done.exception!r} {done.output}"
    assert 0 == done.return_value, f"{line}: {done.output}"
    assert done.output
    # A finished run stays as it is when it is resumed.
    left = {
        str(path)
        for path, state in _changes().items()
        if name == "resume" or before.get(path) != state
    }
    for path in _promised(name, arguments):
        assert fnmatch.filter(left, path), f"{line}: {path} not in {sorted(left)}"
    return done.output


def _changes() -> dict[Path, tuple[int, int]]:
    files = [path for path in Path().rglob("*") if path.is_file()]
    return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in files}


def _promised(name: str, arguments: list[str]) -> list[str]:
    """Return the files that a command line is to write, from the folder that it is typed in."""
    home, files = LEAVES[name]
    options = dict(pairwise(arguments))
    words = {
        "stem": Path(next(iter(arguments), "")).stem,
        "record": Path(options.get("--record", options.get("--signal", ""))).stem,
    }
    home = options.get("--out", home.format(*arguments, **words))
    return [str(Path(home) / one.format(*arguments, **words)) for one in files.split()]

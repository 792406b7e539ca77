"""Every example that people are shown is run: in README, help texts and notebooks.

They are collected from these texts, so that a new one is run by itself. The README's Python is in
``test_readme.py``, docstrings are run by ``test_public_names.py``, and the notebooks' cells by
``test_examples.py``. Each command is run once; ``-m slow`` runs every line and config.
"""

import os
import re
import shlex
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

from bwbayes.app.commands import cli
from bwbayes.app.config.config import load
from bwbayes.app.study.resolve import resolve_config
from tests.app import small
from tests.examples import (
    LEAVES,
    QUICK,
    README,
    blocks,
    guides,
    lines_of_shell,
    records_of,
    shorter,
    typed,
    with_files,
)

SHOWN = lines_of_shell()
COMMANDS = [line for line in SHOWN if line.startswith("bwbayes ")]

# With words in capitals for what a reader fills in.
PATTERNS = [line for line in COMMANDS if re.search(r" [A-Z]+\b(?!:)", line)]

# The README's first record goes from one line to the next.
FIRST = [line.partition("#")[0].strip() for line in blocks("sh")[2].splitlines()]

# Lines that are not run here, and where they are.
ELSEWHERE = {
    "python3 -m venv": "the fixture `summary` of test_readme.py; pip in test_packaging.py",
    "dask ": "app/test_executors.py",
    "bwbayes calibrate runs/calibration.toml --replicates 1000 --executor": "and this with it",
}


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small.finished(tmp_path_factory)


def elsewhere(line: str) -> bool:
    return line.startswith(tuple(ELSEWHERE))


def test_every_line_is_run_somewhere() -> None:
    assert [] == [line for line in SHOWN if line not in COMMANDS and not elsewhere(line)]
    for start in ELSEWHERE:
        assert any(line.startswith(start) for line in SHOWN), start
    assert set(cli.cli.commands) == set(LEAVES)


def test_each_command_takes_its_lines() -> None:
    for line in COMMANDS:
        _, name, *given = shlex.split(line)
        assert cli.cli.commands[name].make_context(name, given).params


RUN_HERE = [line for line in COMMANDS if line not in PATTERNS + FIRST and not elsewhere(line)]

# The first line of each command that is neither among those of a first record, nor takes long and
# is run by ``app/test_control.py`` and ``app/test_campaign.py``.
QUICK_LINES = {line.split()[1]: line for line in reversed(RUN_HERE)}
for name in (*(line.split()[1] for line in FIRST), "track", "campaign"):
    QUICK_LINES.pop(name, None)


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=() if line in QUICK_LINES.values() else pytest.mark.slow)
        for line in RUN_HERE
    ],
)
def test_a_command_leaves_what_it_promises(line: str, empty: Path, run: Path) -> None:
    with_files(line, empty, run)
    typed(line)


def test_the_commands_for_a_first_record_follow_each_other(empty: Path) -> None:
    """In the order in which a reader types them, with the README's first config."""
    (empty / "my.toml").write_text(blocks("toml")[0] + QUICK)
    records_of('file = "my_record.csv" file = "next.csv"', empty)
    assert FIRST[0].startswith("bwbayes run my_record.csv")
    said = [typed(line) for line in FIRST]
    assert re.search(
        r"training on 0 to [\d.]+, .* s, holding out the rest; save this conf", said[0]
    )


# The first is run above.
CONFIGS = [text for page in (README, *guides().values()) for text in blocks("toml", page)][1:]


@pytest.mark.parametrize("text", CONFIGS)
def test_a_config_is_understood(text: str, empty: Path) -> None:
    assert resolve_config(load(Path(written(text, empty))), empty).study.posterior.prior.dimensions


@pytest.mark.slow
@pytest.mark.parametrize("text", CONFIGS)
def test_a_config_is_run(text: str, empty: Path) -> None:
    typed(f"bwbayes run {written(text, empty)}")


def written(text: str, folder: Path) -> str:
    """Write a config, with the record of the first one if it names none, and what it names."""
    text = text if "[record" in text else f"{blocks('toml')[0].partition('[model]')[0]}{text}"
    text = shorter(text) if "[sampling]" in text else text + QUICK
    records_of(text, folder)
    (folder / "my.toml").write_text(text)
    return "my.toml"


# The notebooks run from top to bottom, and are stored as such a run leaves them.
# One runs in the default suite, all with ``-m slow``.
#
# After a change, ``jupyter execute --inplace notebooks/NAME.ipynb`` stores the new outputs.


ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MAX_FILE_SIZE = 600_000
LONGEST_CELL = 300  # s

QUICK_NOTEBOOKS = "reading_the_paper"

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def outputs_as_text(outputs: list[Any]) -> str:
    parts = []
    for output in outputs:
        parts.append(output.get("text", ""))
        data = output.get("data", {})
        parts += [str(v) for kind, v in data.items() if not kind.startswith("image/")]
    return "\n".join(parts)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path, id=path.stem, marks=() if path.stem == QUICK_NOTEBOOKS else pytest.mark.slow
        )
        for path in NOTEBOOKS
    ],
)
def test_a_notebook_runs_without_an_error(path: Path, tmp_path: Path) -> None:
    """Its own assertions included; on this checkout, and leaving nothing beside it."""
    notebook = nbformat.read(path, as_version=4)
    before = sorted(path.parent.iterdir())
    client = NotebookClient(
        notebook,
        timeout=LONGEST_CELL,
        kernel_name="python3",
        resources={"metadata": {"path": str(path.parent)}},
    )
    client.execute(env={**os.environ, "PYTHONPATH": str(ROOT), "IPYTHONDIR": str(tmp_path)})
    assert before == sorted(path.parent.iterdir())


@every_notebook
def test_a_notebook_is_stored_with_the_outputs_of_one_run(path: Path) -> None:
    """Small, with pictures, and naming no absolute path, no warning and no address in memory."""
    cells = [c for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    assert list(range(1, len(cells) + 1)) == [cell.execution_count for cell in cells]
    outputs = [output for cell in cells for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    for output in outputs:
        assert output.output_type != "error"
        assert output.get("name") != "stderr"
    text = outputs_as_text(outputs)
    assert [] == re.findall(r"(?<![\w.])/(?:\w+/)+\w*|[A-Z]:\\\w*|0x[0-9a-f]{6,}", text)
    assert MAX_FILE_SIZE > path.stat().st_size

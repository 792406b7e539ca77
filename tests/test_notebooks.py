"""The notebooks run from top to bottom, and are stored as such a run leaves them.

After a change, ``jupyter execute --inplace notebooks/NAME.ipynb`` stores the new outputs.
"""

# mypy: allow-untyped-calls
# nbformat says that it has types, but its functions have none.

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LARGEST_FILE = 600_000
LONGEST_CELL = 300  # s

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs_as_text(notebook: Any) -> str:
    """All outputs but the pictures."""
    parts = []
    for cell in code_cells(notebook):
        for output in cell.outputs:
            parts.append(output.get("text", ""))
            data = output.get("data", {})
            parts += [str(v) for kind, v in data.items() if not kind.startswith("image/")]
    return "\n".join(parts)


def test_there_is_a_notebook() -> None:
    assert NOTEBOOKS


@every_notebook
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
    cells = code_cells(nbformat.read(path, as_version=4))
    assert list(range(1, len(cells) + 1)) == [cell.execution_count for cell in cells]
    pictures = [o for c in cells for o in c.outputs if "image/png" in o.get("data", {})]
    assert pictures


@every_notebook
def test_a_notebooks_outputs_name_no_place_and_no_error(path: Path) -> None:
    """Neither an absolute path, nor a warning or an address in memory."""
    notebook = nbformat.read(path, as_version=4)
    for cell in code_cells(notebook):
        for output in cell.outputs:
            assert output.output_type != "error"
            assert output.get("name") != "stderr"
    text = outputs_as_text(notebook)
    assert [] == re.findall(r"(?<![\w.])/(?:\w+/)+\w*|[A-Z]:\\\w*|0x[0-9a-f]{6,}", text)


@every_notebook
def test_a_notebook_is_a_small_file(path: Path) -> None:
    assert LARGEST_FILE > path.stat().st_size

"""The notebooks run from top to bottom, and are stored as such a run leaves them.

One runs in the default suite, all with ``-m slow``.

After a change, ``jupyter execute --inplace notebooks/NAME.ipynb`` stores the new outputs.
"""

# mypy: allow-untyped-calls
# nbformat says that it has types, but its functions have none.

import os
import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MAX_FILE_SIZE = 600_000
LONGEST_CELL = 300  # s

QUICK = "reading_the_paper"

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
        pytest.param(path, id=path.stem, marks=() if path.stem == QUICK else pytest.mark.slow)
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

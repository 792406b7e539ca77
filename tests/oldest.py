r"""The oldest versions that ``pyproject.toml`` allows, as constraints for pip.

They are tried without warnings as errors, because old versions deprecate what newer ones have
removed; lint, types and browser stay out, since they are the same everywhere::

    python3.12 -m venv .oldest && python3 -m tests.oldest > .oldest/oldest.txt
    .oldest/bin/pip install . pytest pytest-xdist hypothesis pyyaml -c .oldest/oldest.txt
    .oldest/bin/pip install nbclient nbformat ipykernel 'distributed==2024.12' 'npTDMS==1.9' \
        'openpyxl==3.1' -c .oldest/oldest.txt
    .oldest/bin/python -m pytest -n 2 -W default --ignore tests/test_style.py \
        --ignore tests/test_packaging.py

A newer Python and the newest versions are tried without the constraints, and with warnings as
errors.
"""

import re
import tomllib
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"


def constraints(requirements: list[str]) -> list[str]:
    """Return a line ``name==version`` for each requirement ``name>=version; markers``.

    Raises
    ------
    ValueError
        A requirement has no lower bound, or more than that.
    """
    lines = []
    for one in requirements:
        bound = re.fullmatch(r"([\w.-]+)>=([\d.]+)", one.partition(";")[0].strip())
        if bound is None:
            raise ValueError(f"{one}: write a lower bound, and nothing else")
        lines.append(f"{bound[1]}=={bound[2]}")
    return lines


if __name__ == "__main__":
    project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    print(*constraints(project["dependencies"]), sep="\n")

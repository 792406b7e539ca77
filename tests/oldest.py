"""The oldest versions that ``pyproject.toml`` allows, as constraints for pip.

``python -m tests.oldest > oldest.txt`` and ``pip install '.[test]' -c oldest.txt`` make an
environment of them; CONTRIBUTING.md has the commands.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

__all__ = ["constraints"]

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

"""What the tests of the chain's file share: one that was never interrupted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from bwbayes.sampling.storage import ChainFile
from tests.sampling.chains import arrays, finish, new


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a run that was never interrupted."""
    path = tmp_path_factory.mktemp("whole") / "chain.h5"
    with new(path) as chain:
        finish(chain)
    return path


@pytest.fixture(scope="session")
def expected(whole: Path) -> dict[str, Any]:
    """Return all arrays of its chain."""
    return arrays(ChainFile.read(whole))

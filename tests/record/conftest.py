"""Fixtures of the records' tests: one folder for all examples, and a mark of silence."""

from pathlib import Path

import pytest

quiet = pytest.mark.filterwarnings("ignore::bwbayes.errors.InputWarning")


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder whose files each example writes anew."""
    return tmp_path_factory.mktemp("examples")

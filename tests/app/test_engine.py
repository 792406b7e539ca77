"""A run remembers its engine; another one gives the same posterior, but is not slipped in."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from bwbayes.app.config.config import load
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.errors import InputError
from bwbayes.sampling.storage import ChainFile
from tests.app import small


def test_chain_file_and_summary_name_the_engine(run: Path) -> None:
    assert "numba" == load(RunFolder(run).config).sampling.engine
    attributes = ChainFile.read(RunFolder(run).chain).attributes()
    assert "numba" == attributes["engine"]
    assert "numba" in json.loads(str(attributes["versions"]))
    assert "numba" in small.numbers(run)["versions"]


def test_another_engine_is_refused_unless_asked_for(copy: RunFolder) -> None:
    text = copy.config.read_text().replace('engine = "numba"', 'engine = "numpy"')
    copy.config.write_text(text)
    before = ChainFile.read(copy.chain).steps("sampling")
    with pytest.raises(InputError, match=r'sampled with the numba engine, not numpy.*`engine="num'):
        resume(copy, small.quiet(), workers=1)
    assert before == ChainFile.read(copy.chain).steps("sampling")


@pytest.mark.slow
def test_asked_for_another_engine_goes_on_and_is_said(run: Path, copy: RunFolder) -> None:
    said = StringIO()
    ess = 2 * small.lowest_ess(run)
    result = resume(copy, Console(file=said, width=200), workers=1, ess=ess, engine="numpy")
    assert result.outcome.converged
    assert "resuming with the numpy engine a chain begun with numba" in said.getvalue()
    assert "numpy" == load(copy.config).sampling.engine

"""Four methods on one measured record: what ``runs/beside_others.py`` finds, and README quotes."""

from __future__ import annotations

from pathlib import Path
from runpy import run_path

import pytest

from bwbayes import read_record
from tests.measured import keep
from tests.test_measured_stack import RECORD

RUNS = Path(__file__).parents[1] / "runs"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_the_default_errs_less_than_three_usual_methods() -> None:
    """On large loops as were fitted, and on a decay and a hold, which were not."""
    compared = run_path(str(RUNS / "beside_others.py"))["compare"](read_record(RECORD))
    compared.draw(RUNS / "beside_others.png")
    table = compared.table
    keep("beside others", table)
    ours = table.pop("bwbayes")
    for test in ("large loops", "decay and hold"):
        least = min(row[test]["error_um"] for row in table.values())
        assert ours[test]["error_um"] < 1.1 * least, test

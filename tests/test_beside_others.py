"""Four methods on one measured record: what ``runs/beside_others.py`` finds, and README quotes."""

from pathlib import Path
from runpy import run_path

import pytest

from bwbayes import read_record
from tests.measured import keep
from tests.test_measured_stack import RECORD

RUNS = Path(__file__).parents[1] / "runs"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_the_default_errs_less_on_large_loops_than_three_usual_methods() -> None:
    """On large loops as were fitted. On a decay and a hold least squares may be better."""
    compared = run_path(str(RUNS / "beside_others.py"))["compare"](read_record(RECORD))
    table = compared.table
    keep("beside others", table)
    ours = table.pop("bwbayes")
    for test, factor in {"large loops": 1.0, "decay and hold": 1.5}.items():
        least = min(row[test]["error_um"] for row in table.values())
        assert ours[test]["error_um"] < factor * least, test

"""A prediction leaves bands, scores and a picture, says what does not hold, replaces nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from bwbayes.record import Record, read_record, write_record
from tests.app.conftest import Type


@pytest.fixture
def record(run: Path) -> Record:
    return read_record(run / "records/sine.h5")


def test_scores_and_a_picture_lie_beside_the_bands(
    bwbayes: Type, run: Path, record: Record, tmp_path: Path
) -> None:
    write_record(record, tmp_path / "sine.h5")
    predict = "predict", run, "--record", "sine.h5", "--from-rest", "--out"
    assert 0 == bwbayes(*predict, "new/bands.csv", "--window", 2.0, 3.5).status
    bands = tmp_path / "new/bands.csv"
    result = json.loads(bands.with_suffix(".json").read_text())
    assert (2.0, 3.5) == pytest.approx((result["from_s"], result["to_s"]))
    assert 75 == result["samples"]
    assert 0 < result["scores"]["nrmse"]
    assert result["holds"] in (True, None)
    assert bands.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    bands.unlink()
    bwbayes(*predict, "new/bands.csv").assert_refused("bands.json: exists", "give `--overwrite`")
    assert not bands.exists()
    bwbayes(*predict, "bands.png").assert_refused("give a name that ends in .csv")


def test_record_that_goes_the_other_way_ends_with_status_3(
    bwbayes: Type, run: Path, record: Record, tmp_path: Path
) -> None:
    assert record.displacement is not None
    write_record(replace(record, displacement=-record.displacement), tmp_path / "turned.h5")
    said = bwbayes("predict", run, "--record", "turned.h5", "--from-rest", "--out", "bands.csv")
    assert 3 == said.status
    assert said.out.startswith(
        "VALIDATION FAILED: turned (separate record): the readings fall where the voltage rises"
    )
    assert "Likely cause: reversed sign of the displacement. Fix: change" in said.out
    result = json.loads((tmp_path / "bands.json").read_text())
    assert (False, "sign") == (result["holds"], result["cause"])


def test_a_files_own_columns_are_recognized(
    bwbayes: Type, run: Path, record: Record, tmp_path: Path
) -> None:
    """As by `bwbayes run`: a user's next file has the columns of the first."""
    assert record.displacement is not None
    rows = zip(1e3 * record.time, record.voltage, record.displacement, strict=True)
    lines = ["# voltage: command", "t [ms],drive (V),pos_um"]
    lines += [f"{t:.9g},{v:.12g},{y:.12g}" for t, v, y in rows]
    (tmp_path / "sine.csv").write_text("\n".join(lines) + "\n")
    said = bwbayes("predict", run, "--record", "sine.csv", "--from-rest", "--out", "bands.csv")
    assert 0 == said.status
    result = json.loads((tmp_path / "bands.json").read_text())
    assert record.samples == result["samples"]
    assert result["holds"] in (True, None)

"""A prediction leaves bands, scores and a picture, says what does not hold, replaces nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from bwbayes.app.commands.products import predict
from bwbayes.errors import InputError
from bwbayes.record import Record, read_record, write_record
from tests.app import small


@pytest.fixture
def record(run: Path) -> Record:
    return read_record(run / "records/sine.h5")


def test_scores_and_a_picture_lie_beside_the_bands(
    run: Path, record: Record, tmp_path: Path
) -> None:
    write_record(record, tmp_path / "sine.h5")
    out = tmp_path / "new/bands.csv"
    arguments = run, "--record", tmp_path / "sine.h5", "--from-rest", "--out", out
    assert 0 == small.typed(predict, *arguments, "--window", 2.0, 3.5)
    result = json.loads(out.with_suffix(".json").read_text())
    assert (2.0, 3.5) == pytest.approx((result["from_s"], result["to_s"]))
    assert 75 == result["samples"]
    assert 0 < result["scores"]["nrmse"]
    assert result["holds"] in (True, None)
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    out.unlink()
    with pytest.raises(InputError, match=r"bands.json: exists; choose .* give `overwrite=True`"):
        small.typed(predict, *arguments)
    assert not out.exists()
    with pytest.raises(InputError, match=r"give a name that ends in \.csv"):
        small.typed(predict, *arguments[:-1], tmp_path / "bands.png")


def test_record_that_goes_the_other_way_ends_with_status_3(
    run: Path, record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert record.displacement is not None
    write_record(replace(record, displacement=-record.displacement), tmp_path / "turned.h5")
    out = tmp_path / "bands.csv"
    record_options = "--record", tmp_path / "turned.h5", "--from-rest"
    assert 3 == small.typed(predict, run, *record_options, "--out", out)
    said = capsys.readouterr().out
    assert said.startswith(
        "VALIDATION FAILED: turned (separate record): the readings fall where the voltage rises"
    )
    assert "Likely cause: reversed sign of the displacement. Fix: change" in said
    result = json.loads(out.with_suffix(".json").read_text())
    assert (False, "sign") == (result["holds"], result["cause"])


def test_a_files_own_columns_are_recognized(run: Path, record: Record, tmp_path: Path) -> None:
    """As by `bwbayes run`: a user's next file has the columns of the first."""
    assert record.displacement is not None
    rows = zip(1e3 * record.time, record.voltage, record.displacement, strict=True)
    lines = [
        "# voltage: command",
        "t [ms],drive (V),pos_um",
        *(f"{t:.9g},{v:.12g},{y:.12g}" for t, v, y in rows),
    ]
    (tmp_path / "sine.csv").write_text("\n".join(lines) + "\n")
    out = tmp_path / "bands.csv"
    record_options = "--record", tmp_path / "sine.csv", "--from-rest"
    assert 0 == small.typed(predict, run, *record_options, "--out", out)
    result = json.loads(out.with_suffix(".json").read_text())
    assert record.samples == result["samples"]
    assert result["holds"] in (True, None)

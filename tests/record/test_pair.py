"""Voltage and displacement in files of their own are one record."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.errors import ColumnsError, InputError
from bwbayes.record import read_record

SAMPLES = 40
TIME = 0.5 + 0.005 * np.arange(SAMPLES)
STEPS = np.arange(SAMPLES)
VALUES = {"voltage": 30.0 * np.sin(STEPS), "displacement": 9.0 * np.cos(STEPS)}
UNITS = {"voltage": "V", "displacement": "um"}
HEADERS = {
    "voltage": ["U [V]", "amp (V)"],
    "displacement": ["sensor / um", "gauge (um)", "y in um"],
}


def written(
    path: Path, quantity: str, header: str, separator: str, decimal: str, *, timed: bool
) -> Path:
    columns = [TIME, VALUES[quantity]] if timed else [VALUES[quantity]]
    rows = [
        separator.join(f"{x:.6f}".replace(".", decimal) for x in row)
        for row in zip(*columns, strict=True)
    ]
    head = [separator.join(["t (s)"] * timed + [header])] if header else []
    path.write_text("\n".join([*head, *rows]) + "\n")
    return path


@given(
    headers=st.tuples(*(st.sampled_from([*HEADERS[q], ""]) for q in VALUES)),
    timed=st.tuples(st.booleans(), st.booleans()),
    separator=st.sampled_from([";", "\t", " "]),
    decimal=st.sampled_from(".,"),
)
def test_two_files_are_a_record_whatever_their_only_columns_are_called(
    folder: Path, headers: tuple[str, str], timed: tuple[bool, bool], separator: str, decimal: str
) -> None:
    """With times in both, one or neither; a column without a name has no unit either."""
    files = {}
    for quantity, header, has_times in zip(VALUES, headers, timed, strict=True):
        # Times need a name, or nothing tells them from values.
        files[quantity] = written(
            folder / f"{quantity}.txt",
            quantity,
            header,
            separator,
            decimal,
            timed=has_times and bool(header),
        )
    is_timed = any(has_times and header for has_times, header in zip(timed, headers, strict=True))
    options: dict[str, Any] = {
        "units": {q: UNITS[q] for q, header in zip(UNITS, headers, strict=True) if not header}
    }
    options |= {} if is_timed else {"fs": 200.0}
    record = read_record(files["voltage"], displacement_file=files["displacement"], **options)
    np.testing.assert_allclose(record.voltage, VALUES["voltage"], atol=1e-6)
    np.testing.assert_allclose(np.asarray(record.displacement), VALUES["displacement"], atol=1e-6)
    assert record.interval == pytest.approx(0.005)
    assert record.start == (0.5 if is_timed else 0.0)
    assert record.origin == "voltage.txt, displacement.txt"


def test_all_that_is_open_of_both_files_is_asked_at_once(tmp_path: Path) -> None:
    form: dict[str, Any] = {"header": "", "separator": ";", "decimal": "."}
    files = [written(tmp_path / f"{q}.txt", q, **form, timed=False) for q in VALUES]
    with pytest.raises(ColumnsError) as caught:
        read_record(files[0], displacement_file=files[1])
    command = str(caught.value.in_command("bwbayes run"))
    assert "--unit voltage=V --unit displacement=um --fs" in command
    assert "--column" not in command
    for file in files:
        written(file, file.stem, **form, timed=True)
    with pytest.raises(ColumnsError) as caught:
        read_record(files[0], displacement_file=files[1])
    guess: dict[str, Any] = caught.value.guess
    assert guess["columns"] == {"time": "1", "voltage": "2", "displacement": "2"}
    record = read_record(files[0], displacement_file=files[1], **guess)
    np.testing.assert_allclose(np.asarray(record.displacement), VALUES["displacement"], atol=1e-6)


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (lambda rows: rows[:-3], "displacement.txt: 37 displacements for 40 voltages in "),
        (
            lambda rows: [row.replace("0.550", "0.552") for row in rows],
            "displacement.txt: t (s): sample 10 is at 0.552 s, in ",
        ),
        (lambda rows: [*rows[:5], "0.520000;1.5x", *rows[6:]], "txt:6: y (um): '1.5x' is not a nu"),
    ],
)
def test_files_that_do_not_fit_together_are_one_line(
    tmp_path: Path, spoil: Any, problem: str
) -> None:
    form: dict[str, Any] = {"separator": ";", "decimal": ".", "timed": True}
    voltage = written(tmp_path / "voltage.txt", "voltage", "u (V)", **form)
    other = written(tmp_path / "displacement.txt", "displacement", "y (um)", **form)
    other.write_text("\n".join(spoil(other.read_text().splitlines())))
    with pytest.raises(InputError) as caught:
        read_record(voltage, displacement_file=other)
    assert problem in str(caught.value)
    assert "; " in str(caught.value)


def test_a_file_of_the_voltage_alone_needs_another(tmp_path: Path) -> None:
    form: dict[str, Any] = {"separator": ";", "decimal": ".", "timed": True}
    voltage = written(tmp_path / "voltage.txt", "voltage", "u (V)", **form)
    with pytest.raises(InputError, match="no column for the displacement; add it, or say in which"):
        read_record(voltage)
    assert read_record(voltage, need_displacement=False).samples == SAMPLES

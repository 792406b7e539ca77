"""Text records: what is accepted, and one line for everything that is not."""

import gzip
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st

from bwbayes.errors import ColumnsError, InputError, InputWarning
from bwbayes.record import Record, read_record, write_record
from tests.record.conftest import quiet

HEADER = "time_s,voltage_V,displacement_um"
ROWS = [f"{i * 0.005:.3f},{np.sin(i):.4f},{20 * np.cos(1.3 * i):.4f}" for i in range(30)]
LINES = [HEADER, *ROWS]
GOOD = "\n".join(LINES) + "\n"


def read(folder: Path, content: str | bytes) -> Record:
    path = folder / "record.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_record(path)


def fault(folder: Path, content: str | bytes) -> str:
    with pytest.raises(InputError) as caught:
        read(folder, content)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    assert "; " in text
    return text.removeprefix(f"{folder}/")


def cell(line: int, column: int, text: str) -> str:
    """Return the good file with another text in one cell (line 2 is the first sample's)."""
    cells = LINES[line - 1].split(",")
    cells[column] = text
    return lines(*LINES[: line - 1], ",".join(cells), *LINES[line:])


def lines(*texts: str) -> str:
    return "\n".join(texts) + "\n"


HARMLESS = {
    "bom": b"\xef\xbb\xbf" + GOOD.encode(),
    "crlf": GOOD.replace("\n", "\r\n").encode(),
    "cr": GOOD.replace("\n", "\r").encode(),
    "no-last-newline": GOOD.rstrip("\n").encode(),
    "blank-end": (GOOD + "\n  \n").encode(),
    "blanks beside commas": GOOD.replace(",", " , ").encode(),
    "blanks and indented": GOOD.replace(",", "  ").replace("\n", "\n  ").rstrip(" ").encode(),
    "semicolons below": lines(HEADER, *(row.replace(",", ";") for row in ROWS)).encode(),
    "header in a comment": ("# " + GOOD).encode(),
    "utf-16-le": GOOD.encode("utf-16-le"),
    "utf-16-be": GOOD.encode("utf-16-be"),
    "cp1252": GOOD.replace("_um", "_µm").encode("cp1252"),
    "other names": GOOD.replace("_um", " [µm]").replace("time_s", "Zeit / s").encode("cp1252"),
    "units in a line": GOOD.replace(HEADER, "time,voltage,displacement\n(s),(V),(um)\n").encode(),
    "mu": GOOD.replace("_um", "_\u03bcm").encode(),
    "case": GOOD.replace("time", "TIME").replace("volt", "Volt").encode(),
    "order": lines(*(",".join(line.split(",")[::-1]) for line in LINES)).encode(),
    "comments": ("# anything\n# at all: yes\n\n" + GOOD).encode(),
    "comments below": (GOOD + "\n% 30 samples\n# end").encode(),
    "Markdown": lines(
        *(f"| {line.replace(',', ' | ')} |" for line in (HEADER, "---,---:,:---:", *ROWS))
    ).encode(),
    "french": GOOD.replace(HEADER, "Temps (s),Tension (V),Déplacement (µm)").encode("cp1252"),
}


@pytest.mark.parametrize("content", HARMLESS.values(), ids=HARMLESS)
def test_harmless_differences_change_nothing(tmp_path: Path, content: bytes) -> None:
    assert read(tmp_path, GOOD).sha256 == read(tmp_path, content).sha256


@pytest.mark.parametrize(
    ("added", "count"),
    [(["", " "], "2 lines"), (["# paused, by hand"], "1 line"), ([HEADER], "1 line")],
    ids=["empty", "comment", "header"],
)
def test_lines_among_the_numbers_that_are_no_samples_are_skipped_with_a_remark(
    tmp_path: Path, added: list[str], count: str
) -> None:
    with pytest.warns(InputWarning, match=f"csv:9: {count} among the numbers skipped"):
        record = read(tmp_path, lines(*LINES[:8], *added, *LINES[8:]))
    assert record.sha256 == read(tmp_path, GOOD).sha256


@pytest.mark.filterwarnings("ignore:.*2 lines among the numbers skipped")
def test_lines_count_in_the_file_where_some_are_skipped(tmp_path: Path) -> None:
    text = lines(*LINES[:8], "# paused", "", *LINES[8:20], LINES[10], *LINES[21:])
    assert fault(tmp_path, text).startswith("record.csv:23: time_s: time goes back from 0.09 s to")


@given(
    st.integers(1, len(ROWS[-1])),
    st.lists(st.sampled_from(["Mean,0.1,0.2", "End of file", "Mean", "", "# end"]), max_size=3),
)
def test_a_line_that_is_cut_off_and_words_below_the_numbers_are_skipped_with_a_remark(
    folder: Path, lost: int, below: list[str]
) -> None:
    """Wherever a logger was killed, in mid-line or in mid-number, and whatever stands below."""
    cut = lines(*LINES, *below) if below else GOOD[: -1 - lost]
    whole = read(folder, lines(*(LINES if below else LINES[:-1])))
    if any(line[:1].isalpha() for line in below) or not cut.endswith("\n"):
        line = rf"csv:{32 if below else 31}: \d lines? among the numbers skipped"
        with pytest.warns(InputWarning, match=line):
            record = read(folder, cut)
    else:
        record = read(folder, cut)
    assert whole.sha256 == record.sha256


@pytest.mark.parametrize("times", [["0.31"], ["0.31", "0.32", "0.33"]])
def test_times_alone_at_the_end_are_skipped_with_a_remark(tmp_path: Path, times: list[str]) -> None:
    with pytest.warns(InputWarning, match=r"csv:32: \d lines? among the numbers skipped"):
        record = read(tmp_path, lines(*LINES, *times))
    assert record.sha256 == read(tmp_path, GOOD).sha256


@quiet
def test_a_row_like_one_above_the_numbers_stays(tmp_path: Path) -> None:
    rows = ["0.1,OVLD", *(f"{np.sin(i):.4f},{np.cos(i):.4f}" for i in range(250)), "0.1,OVLD"]
    path = tmp_path / "record.csv"
    path.write_text(lines("voltage_V,displacement_um", *rows, "0.2,0.3"))
    record = read_record(path, fs=100.0)
    assert record.voltage[-2:].tolist() == [0.1, 0.2]


@pytest.mark.parametrize("mark", ["'", "\u2019", "\u202f", "\u00a0"])
def test_thousands_may_be_marked_as_where_no_comma_does(tmp_path: Path, mark: str) -> None:
    rows = [
        f"{i * 0.005:.3f};{np.sin(i):.4f};{1 + i}{mark}{i:03d}{mark}{i:03d}.5" for i in range(30)
    ]
    record = read(tmp_path, lines(HEADER.replace(",", ";"), *rows))
    assert record.displacement is not None
    np.testing.assert_array_equal(
        record.displacement, [1e6 * (1 + i) + 1e3 * i + i + 0.5 for i in range(30)]
    )


@pytest.mark.parametrize("text", ["1.#INF", "-1.#IND", "1.#QNAN000"])
def test_what_c_writes_for_no_number_is_a_missing_reading(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, cell(9, 2, text)).readings == 29


@quiet
@given(
    separator=st.sampled_from([";", "\t", "|", ",", " "]),
    decimal=st.sampled_from(".,"),
    is_quoted=st.booleans(),
    millis=st.booleans(),
    decimals=st.sampled_from([0, 0, 1, 2, 3, 5]),
    top=st.sampled_from([1100.0, 30_000.0, 4e7]),
    word=st.sampled_from(["", "#DIV/0!"]),
    seed=st.integers(0, 2**32),
)
def test_thousands_are_read_whatever_marks_them(
    folder: Path,
    separator: str,
    decimal: str,
    is_quoted: bool,
    millis: bool,
    decimals: int,
    top: float,
    word: str,
    seed: int,
) -> None:
    """As spreadsheets write them: either mark, numbers below 1,000 without one, quoted or not.

    Times have decimals, or are whole milliseconds. A word is a missing reading among them too.
    """
    marks = str.maketrans(",.", ",." if decimal == "." else ".,")
    rng = np.random.default_rng(seed)
    values = np.round(top * np.sin(np.arange(200) / 9 + rng.uniform(0, 6, (2, 1))), decimals)
    time = [f"{5 * i:,}" if millis else f"{0.005 * i:.3f}" for i in range(200)]
    rows = [[t, *(f"{x:,.{decimals}f}" for x in xs)] for t, *xs in zip(time, *values, strict=True)]
    rows = [[text.translate(marks) for text in row] for row in rows]
    if word:
        rows[50][2] = word
    if separator == "," or (is_quoted and separator != " "):
        rows = [[f'"{text}"' for text in row] for row in rows]
    header = separator.join([f"time_{'ms' if millis else 's'}", "voltage_mV", "displacement_nm"])
    record = read(folder, lines(header, *(separator.join(row) for row in rows)))
    expected = values / 1000
    expected[1, 50] = np.nan if word else expected[1, 50]
    assert 0.005 == record.interval
    np.testing.assert_allclose(record.voltage, expected[0], rtol=1e-12)
    np.testing.assert_allclose(np.asarray(record.displacement), expected[1], rtol=1e-12)


@quiet
@given(
    start=st.integers(0, 1),
    form=st.sampled_from([".6f", ".18e", ".1f", "g", "d"]),
    separator=st.sampled_from([",", ";", "\t", " "]),
    seed=st.integers(0, 2**32),
)
def test_numbers_for_names_are_no_reading_and_a_first_sample_of_such_is_one(
    folder: Path, start: int, form: str, separator: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    columns = [5.0 * np.arange(60), *np.rint(rng.uniform(-300, 300, (2, 60)))]
    rows = [
        separator.join(f"{int(x) if form == 'd' else x:{form}}" for x in row)
        for row in zip(*columns, strict=True)
    ]
    path = folder / "numbered.csv"
    units = {"time": "ms", "voltage": "V", "displacement": "um"}
    options: dict[str, Any] = {
        "columns": {"time": 1, "voltage": 2, "displacement": 3},
        "units": units,
    }
    path.write_text(lines(separator.join(str(start + i) for i in range(3)), *rows))
    record = read_record(path, **options)
    assert (60, 0.005) == (record.samples, record.interval)
    np.testing.assert_array_equal(record.voltage, columns[1])
    ramp = [separator.join(f"{x + i:g}" for x in range(3)) for i in range(60)]
    path.write_text(lines(*ramp))
    assert 60 == read_record(path, **options).samples


@quiet
@pytest.mark.parametrize(
    "header",
    [
        "# time (s) voltage (V) displacement (um)",
        "# elapsed time (s) drive voltage [V] sensor displacement (um)",
        "time(s) voltage(V) displacement(um)",
        "time / s voltage / V displacement / um",
        "elapsed time [s]  drive voltage [V]  displacement [um]",
    ],
)
def test_names_of_several_words_stand_above_numbers_between_blanks(
    tmp_path: Path, header: str
) -> None:
    text = lines(header, *(row.replace(",", " ") for row in ROWS))
    assert read(tmp_path, text).sha256 == read(tmp_path, GOOD).sha256


@quiet
@pytest.mark.parametrize(
    "end", [[",,"], [",,", '"","",""', ""], ["0.150,,"], ["0.150,,", "0.155,,"]]
)
def test_rows_without_a_voltage_and_a_displacement_at_the_end_are_none(
    tmp_path: Path, end: list[str]
) -> None:
    assert read(tmp_path, lines(*LINES, *end)).sha256 == read(tmp_path, GOOD).sha256


def test_of_equal_columns_of_one_name_one_is_taken_and_of_others_none(tmp_path: Path) -> None:
    twice = [f"{line},{line.split(',')[1]}" for line in LINES]
    with (
        pytest.warns(InputWarning, match=r"columns 2, 4 are all 'voltage_V' with equal numbers"),
        pytest.warns(InputWarning, match="ignored columns"),
    ):
        assert read(tmp_path, lines(*twice)).sha256 == read(tmp_path, GOOD).sha256
    twice[5] += "1"
    assert "which column is the voltage" in fault(tmp_path, lines(*twice))


def test_decimals_of_three_digits_are_no_thousands(tmp_path: Path) -> None:
    for separator, decimal in ((",", "."), (";", "."), (";", ",")):
        rows = [f"{i}|{1 + i / 7:.3f}|{7 + np.sin(i):.3f}" for i in range(500)]
        rows = [row.replace(".", decimal).replace("|", separator) for row in rows]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            record = read(tmp_path, lines("time_ms,voltage_V,displacement_um", *rows))
        assert 1.143 == record.voltage[1]
        # Which reading was taken is said, unless commas between columns leave no other.
        said = [str(remark.message) for remark in caught]
        expected = f"1{decimal}000 is read as 1.000; write numbers without marks"
        assert [expected in text for text in said] == [True] * (separator != ",")


def test_whole_numbers_with_marks_alone_are_said_to_be_such(tmp_path: Path) -> None:
    rows = [f"{i};{100 * i:,};{150 * i:,}" for i in range(30)]
    with pytest.warns(InputWarning, match="csv: 1,000 is read as 1000; write numbers without"):
        record = read(tmp_path, lines("time_ms;voltage_mV;displacement_nm", *rows))
    assert 2.9 == record.voltage[-1]


@quiet
@given(
    order=st.sampled_from(["names, units", "units, names"]),
    settings=st.lists(
        st.sampled_from(["Vertical Units,CH1:V", "Model Number,SDS1204", "Source,CH1,CH2"]),
        min_size=2,
        max_size=4,
    ),
    comma=st.sampled_from(["", ","]),
)
def test_units_may_stand_above_names_below_settings(
    folder: Path, order: str, settings: list[str], comma: str
) -> None:
    """As oscilloscopes write them, each line of the header with a comma at its end or without."""
    head = ["time,voltage,displacement", "s,V,um"][:: 1 if order == "names, units" else -1]
    head = [*(settings if order == "units, names" else []), *head]
    record = read(folder, lines(*(f"{line}{comma}" for line in head), *ROWS))
    assert record.sha256 == read(folder, GOOD).sha256


UNIT_ROWS = {"time": ["s", "ms"], "voltage": ["V", "mV"], "displacement": ["um", "\u00b5m", "nm"]}


@quiet
@given(
    rows=st.lists(
        st.tuples(*map(st.sampled_from, UNIT_ROWS.values())).map(list), min_size=2, max_size=3
    ),
    place=st.integers(0, 3),
    left_out=st.sets(st.integers(0, 2), max_size=1),
    said=st.sampled_from([{}, {"time": "s", "voltage": "V", "displacement": "um"}]),
)
def test_rows_of_units_that_contradict_are_asked_for(
    folder: Path, rows: list[list[str]], place: int, left_out: set[int], said: dict[str, str]
) -> None:
    """Wherever the names are among them: nothing but what differs, unless the user has said it.

    A cell that is left out of one row, or the same unit otherwise spelled, contradicts nothing.
    """
    for column in left_out:
        rows[0][column] = ""
    head = [",".join(row) for row in rows]
    head.insert(min(place, len(rows)), "time,voltage,displacement")
    path = folder / "rows.csv"
    path.write_text(lines(*head, *ROWS), encoding="utf-8")
    alike = [{cell.replace("\u00b5", "u") for cell in c} - {""} for c in zip(*rows, strict=True)]
    asked = [q for q, units in zip(UNIT_ROWS, alike, strict=True) if len(units) > 1]
    if asked and not said:
        with pytest.raises(ColumnsError) as caught:
            read_record(path)
        assert asked == list(caught.value.guess["units"])
        return
    record = read_record(path, units=said)
    taken = said or {q: units.pop() for q, units in zip(UNIT_ROWS, alike, strict=True)}
    expected = read_record(_good(folder), units=taken)
    assert record.sha256 == expected.sha256


def _good(folder: Path) -> Path:
    path = folder / "good.csv"
    path.write_text(lines("time,voltage,displacement", *ROWS), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        *((text, f"{text!r} is not a number") for text in ("1.5V", "0x10", "1_000", "(1.5)")),
        ("inf", "inf is not a finite number"),
        ("-Infinity", "-inf is not a finite number"),
        ("1e999", "inf is not a finite number"),
        ("1e12", "1e+12 is absurdly large"),
    ],
)
@pytest.mark.parametrize(("line", "column"), [(2, 1), (17, 2), (31, 1)])
def test_a_bad_cell_is_named_by_line_and_column(
    tmp_path: Path, text: str, problem: str, line: int, column: int
) -> None:
    """An infinite displacement is a missing one."""
    if column == 2 and "finite" in problem:
        with pytest.warns(InputWarning, match=f"csv:{line}: displacement_um: inf 1 time, no numb"):
            assert [line - 2] == np.flatnonzero(
                ~read(tmp_path, cell(line, column, text)).has_reading
            )
        return
    where = f"record.csv:{line}: {HEADER.split(',')[column]}: "
    assert fault(tmp_path, cell(line, column, text)).startswith(where + problem)


@pytest.mark.parametrize(
    "text",
    [
        *("", "  ", "nan", "-NaN", "#N/A", "OVERLOAD", "---", "no signal", "∞", "#DIV/0!"),
        *("ERR 12", "#VALUE!", "*****", "> 9.99", "E2", "OL1.5"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*record.csv.17.*, taken as missing")
def test_a_cell_without_a_number_is_a_missing_reading_but_no_time_or_voltage(
    tmp_path: Path, text: str
) -> None:
    whole, record = read(tmp_path, GOOD), read(tmp_path, cell(17, 2, text))
    assert [15] == np.flatnonzero(~record.has_reading).tolist()
    np.testing.assert_array_equal(whole.voltage, record.voltage)
    for column in (0, 1):
        where = f"record.csv:17: {HEADER.split(',')[column]}: "
        word = bool(text.strip()) and text.lower() not in ("nan", "-nan", "#n/a")
        problem = f"{text!r} is not a number" if word else "no number (empty or nan); give one, or"
        if column == 1 and not word:  # left out, and its gap is not one to bridge
            where, problem = "record.csv:18: time_s: ", "gap of 0.01 s after 0.07 s, about 1 miss"
        assert fault(tmp_path, cell(17, column, text)).startswith(where + problem)


@given(
    word=st.from_regex("[A-Z#<>*][A-Za-z0-9*/! -]{0,9}|-{1,5}", fullmatch=True),
    where=st.sets(st.integers(0, len(ROWS) - 1), min_size=1, max_size=len(ROWS) // 2 - 1),
)
def test_words_are_missing_readings_and_are_said(folder: Path, word: str, where: set[int]) -> None:
    # Numbers to Python, or missing to pandas.
    assume(word.strip().lower().lstrip("-") not in ("inf", "infinity", "na", "nan", "none", "null"))
    rows = [
        row.rpartition(",")[0] + f",{word}" if number in where else row
        for number, row in enumerate(ROWS)
    ]
    line = rf"record.csv:{2 + min(where)}: displacement_um: .*: {len(where)} cells? without"
    with pytest.warns(InputWarning, match=line):
        record = read(folder, lines(HEADER, *rows))
    assert sorted(where) == np.flatnonzero(~record.has_reading).tolist()


def test_too_few_readings_are_refused_and_none_are_a_plan(tmp_path: Path) -> None:
    empty = [row.rpartition(",")[0] + "," for row in ROWS]
    text = fault(tmp_path, lines(HEADER, *ROWS[:9], *empty[9:]))
    assert text.startswith("record.csv: displacement_um: too few readings: 9; give at least 10")
    assert "too few readings: 0" in fault(tmp_path, lines(HEADER, *empty))
    assert read_record(tmp_path / "record.csv", need_displacement=False).displacement is None
    without = lines(*(line.rpartition(",")[0] for line in LINES))
    assert "record.csv:1: no column for the displacement; add it" in fault(tmp_path, without)
    assert read_record(tmp_path / "record.csv", need_displacement=False).displacement is None


def test_a_text_packed_by_gzip_is_the_text(tmp_path: Path) -> None:
    assert read(tmp_path, gzip.compress(GOOD.encode())).sha256 == read(tmp_path, GOOD).sha256
    assert "damaged" in fault(tmp_path, gzip.compress(GOOD.encode())[:-20])
    with pytest.warns(InputWarning, match="1 line above the header skipped"):
        titled = read(tmp_path, gzip.compress(b"PK 7, bench\n" + GOOD.encode()))
    assert titled.sha256 == read(tmp_path, GOOD).sha256


@quiet
@given(
    separator=st.sampled_from([";", "\t", "|", ","]),
    empty=st.lists(st.integers(0, 3), min_size=1, max_size=6),
    names=st.sampled_from([HEADER, "time (s),drive voltage (V),gauge (um)"]),
    commas=st.booleans(),
)
def test_empty_columns_are_none(
    folder: Path, separator: str, empty: list[int], names: str, commas: bool
) -> None:
    """However many there are, and wherever: names and units stay above their numbers."""
    rows = [row.split(",") for row in (names, *ROWS)]
    if commas and separator != ",":
        rows[1:] = [[cell.replace(".", ",") for cell in row] for row in rows[1:]]
    for position in empty:
        rows = [[*row[:position], "", *row[position:]] for row in rows]
    text = lines(*(separator.join(row) for row in rows))
    record = read(folder, text)
    good = read(folder, GOOD)
    assert record.sha256 == good.sha256


@quiet
@given(
    separator=st.sampled_from([";", "\t", "|", ","]),
    scales=st.tuples(
        *(
            st.sampled_from([*u.items()])
            for u in (
                {"s": 1.0, "ms": 1e3},
                {"V": 1.0, "mV": 1e3},
                {"um": 1.0, "\u00b5m": 1.0, "nm": 1e3},
            )
        )
    ),
    blank=st.sampled_from(["", " "]),
    quote=st.sampled_from(["", '"']),
    comma=st.booleans(),
    rule=st.booleans(),
    missing=st.sets(st.integers(0, 28), max_size=3),
)
def test_each_number_may_have_its_unit_behind_it(
    folder: Path,
    separator: str,
    scales: tuple[tuple[str, float], ...],
    blank: str,
    quote: str,
    comma: bool,
    rule: bool,
    missing: set[int],
) -> None:
    """With any separator, decimal points or commas, and where readings are missing."""
    rows = []
    for number, row in enumerate(ROWS):
        cells = [
            f"{float(cell) * scale:.7f}{blank}{unit}"
            for cell, (unit, scale) in zip(row.split(","), scales, strict=True)
        ]
        cells[2] = "" if number in missing else cells[2]
        cells = [cell.replace(".", ",") for cell in cells] if comma else cells
        mark = '"' if comma and separator == "," else quote
        rows.append(separator.join(f"{mark}{cell}{mark}" for cell in cells))
    head = ["time,voltage,displacement", *["---,:--,--:"] * rule]
    text = lines(*(line.replace(",", separator) for line in head), *rows)
    if rule and separator == "|":
        text = re.sub(r"(?m)^(.*)$", r"|\1|", text.rstrip("\n"))
    record = read(folder, text)
    good = read(folder, GOOD)
    assert record.interval == good.interval
    np.testing.assert_allclose(record.voltage, good.voltage, rtol=1e-12)
    expected = np.array(good.displacement)
    expected[[*missing]] = np.nan
    np.testing.assert_allclose(np.array(record.displacement), expected, rtol=1e-12)


@pytest.mark.parametrize("other", ["10 ms", "0.010 V", "0.010"])
def test_a_unit_that_changes_in_a_column_is_none(tmp_path: Path, other: str) -> None:
    rows = [row.replace(",", " s,", 1) for row in ROWS]
    text = lines(HEADER, *rows[:2], f"{other},1,1", *rows[3:])
    assert "not a number" in fault(tmp_path, text)


def test_columns_of_other_quantities_are_ignored_with_a_remark(tmp_path: Path) -> None:
    text = lines("note," + HEADER + ",temp_C,", *(f"a.b,{row},21.5," for row in ROWS))
    with pytest.warns(InputWarning, match=r"record.csv:1: ignored columns: note, temp_C, column 6"):
        record = read(tmp_path, text)
    assert record.sha256 == read(tmp_path, GOOD).sha256


def test_a_command_is_held_where_samples_are_missing_and_an_output_refused(tmp_path: Path) -> None:
    whole = read(tmp_path, GOOD)
    gaps = lines("# voltage: command", *LINES[:9], *LINES[12:20], *LINES[21:])
    with pytest.warns(InputWarning, match=r"csv:11: time_s: 4 samples are missing, .* in 2 gaps"):
        record = read(tmp_path, gaps)
    missing = [8, 9, 10, 19]
    assert missing == np.flatnonzero(~record.has_reading).tolist()
    assert (record.samples, record.interval) == (whole.samples, whole.interval)
    expected = whole.voltage.copy()
    expected[missing] = whole.voltage[[7, 7, 7, 18]]
    np.testing.assert_array_equal(expected, record.voltage)
    with pytest.raises(InputError, match=r"about 3 missing; give the voltage there .* = .command."):
        read_record(tmp_path / "record.csv", voltage_is="output")


FAULTS: dict[str, tuple[str | bytes, str]] = {
    "missing field": (lines(*LINES[:8], "0.1,2", *LINES[9:]), ":9: 2 fields for 3 columns; compl"),
    "extra field": (
        cell(9, 2, "1.5,2.5"),
        ":9: 4 fields for 3 columns; remove '2.5', or write 1.5",
    ),
    "decimal comma": (cell(9, 1, "1,5"), ":9: 4 fields for 3 columns; remove '"),
    "all decimal commas": (
        lines(HEADER, *(row.replace(".", ",") for row in ROWS)),
        ":2: decimal commas, 6 fields for 3 columns; separate them by semicolons",
    ),
    "too few after an empty line": (
        lines(*LINES[:8], "", "# x", *LINES[8:11], "0.050,0.1", *LINES[12:]),
        ":14: 2 fields for 3 columns",
    ),
    "time goes back": (
        lines(*LINES[:8], LINES[5], *LINES[9:]),
        ":9: time_s: time goes back from 0.03 s to 0.02 s; sort the rows",
    ),
    "repeated": (
        lines(*LINES[:8], "0.030,1,1", "0.030,2,2", *LINES[8:]),
        ":9: time_s: 2 times are repeated, first 0.03 s; remove one of two samples, or give `fs=",
    ),
    "one time": (lines(HEADER, *(f"1.5,{i},{i}" for i in range(20))), ": time_s: all times are 1"),
    "gap": (
        lines(*LINES[:8], *LINES[12:]),
        ":9: time_s: gap of 0.025 s after 0.03 s, about 4 missing",
    ),
    "header missing": (
        lines(*ROWS),
        ": which column is the time, which the voltage, which the displacement? 'column 1' is 200 "
        "Hz for 0.145 s in s, 200000 Hz for 0.000145 s in ms, 2e+08 Hz for 1.45e-07 s in us. There "
        "are 30 values each: 'column 1' (0 to 0.145), 'column 2' (-1 to 0.9906), 'column 3' (-19.88"
        " to 20); say "
        "columns={'time': '1', 'voltage': '2', 'displacement': '3'}, units={'time': ",
    ),
    "half of a column words": (
        lines(HEADER, *(row.rpartition(",")[0] + ",Error" for row in ROWS[:15]), *ROWS[15:]),
        ":2: displacement_um: 'Error' is not a number",
    ),
    "endless gap": (
        lines("# voltage: command", *LINES[:20], "1e9,1,1", "1000000000.005,1,1"),
        ":22: time_s: gap of 1e+09 s makes the record too long",
    ),
    "no unit": (GOOD.replace("voltage_V", "voltage"), ":1: which unit has 'voltage' "),
    "no times": (
        lines(*(line.partition(",")[2] for line in LINES)),
        ":1: what is the sampling rate, Hz (no column can be the time; with any other rate dyn",
    ),
    "empty file": ("", ": the file is empty"),
    "one long number": (lines(*LINES, "9" * 200_000), ": a line of 200000 characters;"),
    "one long line": ('{"time": [' + "0.125, " * 30_000 + "0]}", ": a line of 210013 characters;"),
    "header alone": (HEADER, ": no columns of numbers in it"),
    "few samples": (lines(*LINES[:6]), ": too short, samples: 5"),
    "NUL": (cell(9, 1, "\0"), ":9: voltage_V: "),
    "a picture": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), ": neither text nor HDF5"),
    "a workbook": (b"PK\3\4" + bytes(range(256)), ": a workbook or an archive; export it"),
    "constant voltage": (
        lines(HEADER, *(f"{i / 100},1.5,{i}" for i in range(20))),
        ": voltage_V: constant at 1.5",
    ),
    "voltage is what": ("# voltage: comand\n" + GOOD, ": voltage_is: 'comand'"),
    "wrong interval": ("# interval_s: 0.004\n" + GOOD, ": interval_s '0.004'"),
}


@pytest.mark.parametrize(("content", "expected"), FAULTS.values(), ids=FAULTS)
def test_each_fault_is_one_line_with_its_place(
    tmp_path: Path, content: str | bytes, expected: str
) -> None:
    assert fault(tmp_path, content).startswith(f"record.csv{expected}")


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("none.csv", "does not exist"),
        ("", "is a directory"),
        ("record.xyz", "the file is empty"),
        ("bad\0name.csv", "does not exist"),
    ],
)
def test_files_that_cannot_be_opened_say_why(tmp_path: Path, name: str, problem: str) -> None:
    (tmp_path / "record.xyz").touch()
    with pytest.raises(InputError, match=problem):
        read_record(tmp_path / name)


@pytest.mark.parametrize(("rate", "decimals"), [(1024.0, 4), (3.0, 1), (300.0, 3), (44100.0, 6)])
def test_times_rounded_in_print_are_uniform(tmp_path: Path, rate: float, decimals: int) -> None:
    rows = [f"{12.5 + i / rate:.{decimals}f},{i},{i}" for i in range(3000)]
    record = read(tmp_path, lines(HEADER, *rows))
    assert record.interval == pytest.approx(1 / rate, abs=10.0**-decimals / 2999)


def test_the_truth_beside_a_text_is_that_of_its_record(tmp_path: Path) -> None:
    path = tmp_path / "record.csv"
    record = read(tmp_path, GOOD)
    write_record(
        Record(record.voltage, record.displacement, interval=0.1, truth=record.voltage), path
    )
    assert read_record(path).truth is not None
    write_record(record, path)
    assert read_record(path).truth is None
    (tmp_path / "record.truth.csv").write_text(GOOD.replace("\n0.000,", "\n-0.005,0,1\n0.000,"))
    with pytest.raises(InputError, match=r"record.truth.csv: time_s: not the times of the record"):
        read_record(path)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = read(tmp_path, GOOD)

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(InputError, match="disk full"):
        write_record(record, tmp_path / "record.csv")
    assert [tmp_path / "record.csv"] == list(tmp_path.iterdir())
    assert GOOD == (tmp_path / "record.csv").read_text()

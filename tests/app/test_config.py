"""Configs say what is wrong in one line; what is printed of keys and parts is true of them."""

import os
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bwbayes.app.config.config import Config, ModelConfig, dump, is_config, load, parse
from bwbayes.app.config.keys import ANY, Key, keys
from bwbayes.app.config.keywords import config_of, models_of
from bwbayes.app.config.reference import PARTS, config_reference, parts_reference
from bwbayes.errors import InputError
from bwbayes.record.record import Record

RECORD = '[record]\nfile = "record.csv"\n'
SIGNAL = "[record]\nsignal = {duration = 1.0, "


def refused(text: str) -> str:
    with pytest.raises(InputError) as error:
        parse(text, "my.toml")
    said = str(error.value)
    assert "\n" not in said
    assert said.startswith("my.toml: ")
    return said.removeprefix("my.toml: ")


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("sead = 1\n" + RECORD, "sead: unknown key; did you mean seed?"),
        ('[recrod]\nfile = "a.csv"\n', "recrod: unknown key; did you mean record?"),
        ("[record]\nsignal = {amplitud = 1.0}", "signal.amplitud: unknown key; did you mean ampl"),
        (RECORD + "[parameters.d]\nfixd = 1.0", "d.fixd: unknown key; did you mean fixed?"),
        (
            RECORD + "[validation.a]\nsignal = {frequncy = 1.0}",
            "a.signal.frequncy: unknown key; did",
        ),
        (RECORD + "[sampling]\ndraws = 100", "sampling.draws: unknown key; did you mean ess?"),
        (RECORD + "xyzzy = 1", "record.xyzzy: unknown key; known are file, signal, voltage_is, "),
        (RECORD + "seed = 3", "record.seed: unknown key; it belongs above the first table"),
        (RECORD + "walkers = 20", "record.walkers: unknown key; it belongs under [sampling]"),
        ("[record]\nsignal = [1]", "record.signal: write a signal's name or a table like"),
        (RECORD + "[parameters.d]\nprior = 3", "prior: write a table like { distribution"),
        ("record = 3", "record: is not a table; known keys are file, signal"),
        ("", "record: is missing"),
        (RECORD + "signal = 'step10'", "record: give either file or signal; correct it"),
        (
            RECORD + "[validation.a]\nfile = 'a'\nsignal = 'step10'",
            "a: give one of window, file and",
        ),
        (
            RECORD + "[validation.a]\nwindow = [1.0, 2.0]\nlead_in_start = 0.5",
            "is for another record",
        ),
        (RECORD + "[validation.record]\nsignal = 'step10'", "'record' is taken"),
        ("seed = 9223372036854775808\n" + RECORD, "seed"),
        (f"seed = 0x{5000 * 'f'}\n{RECORD}", "seed: "),
        (RECORD + "train = [[0.0, nan]]", "finite"),
        (RECORD + "[parameters.d]\nprior = {distribution = 'normal', mean = nan}", "finite"),
    ],
)
def test_hints_are_near_in_meaning_or_all_keys(text: str, hint: str) -> None:
    assert hint in refused(text)


@pytest.mark.parametrize(
    ("table", "earlier", "now"),  # earlier names
    [
        ("model", "gain", "nonlinearity"),  # earlier name
        ("validation.a", "own_offset", "estimate_offset"),  # earlier name
        ("validation.a", "lead_in_from", "lead_in_start"),  # earlier name
    ],
)
def test_an_earlier_key_is_told_the_new_one(table: str, earlier: str, now: str) -> None:
    told = refused(f"{RECORD}[{table}]\n{earlier} = 1.0")
    assert f"{table}.{earlier}: unknown key; did you mean {now}?" in told


def test_no_error_shows_the_name_of_a_class() -> None:
    for key in ("record", "stand", "model", "sampling", "parameters", "validation", "truth"):
        for value in ("3", "'a'", "[]", "[1]", "true", "{ a = [] }", "{ a = { b = [] } }"):
            said = refused(f"{key} = {value}\n" + ("" if key == "record" else RECORD))
            assert not re.search(r"Config|Model|Table|dict|pydantic|instance|extra inputs", said)


@pytest.mark.parametrize(
    ("table", "key", "text"),
    [
        ("model", "nonlinearity", "quadratic"),
        ("model", "terms", "b3"),
        ("record", "remarks", "noted"),
    ],
)
def test_a_text_is_a_list_of_one(table: str, key: str, text: str) -> None:
    head = RECORD if table == "record" else f"{RECORD}[{table}]\n"
    alone, listed = (parse(f"{head}{key} = {v}\n", "") for v in (f'"{text}"', f'["{text}"]'))
    assert alone == listed
    record = Record(np.arange(20.0), np.arange(20.0), interval=0.1)
    by_keyword, by_list = (config_of(record, {key: value})[0] for value in (text, [text]))
    assert by_keyword == by_list


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("seed = '1'\n" + RECORD, "seed"),
        (RECORD + "train = [1.0, 2.0, 3.0]", "record.train"),
        (RECORD + "voltage_is = 'both'", "record.voltage_is"),
        (f"{SIGNAL}amplitude = -1.0, frequency = 1.0}}", "record.signal.amplitude"),
        (
            f"{SIGNAL}shape = 'steps', levels = [1.0], dwell = 1.0, amplitude = 1.0}}",
            "record.signal",
        ),
        (RECORD + "[parameters.d]\nprior = {distribution = 3}", "parameters.d"),
        (RECORD + "[parameters.d]\nfixed = 1.0\nprior = {distribution = 'beta'}", "parameters.d"),
        (RECORD + "[sampling]\nwalkers = 7", "sampling.walkers"),
        (RECORD + "[truth]\nd = 'large'", "truth.d"),
    ],
)
def test_wrong_value_is_named_with_its_path(text: str, path: str) -> None:
    said = refused(text)
    assert said.startswith(f"{path}")
    assert re.match(r"[:.]", said.removeprefix(path))
    assert said.endswith("; correct it")


@pytest.mark.parametrize(
    "text",
    [
        "[record",
        "seed = 1\nseed = 2\n" + RECORD,
        "a = " + 5000 * "[",
        "\0",
        "seed = " + 5000 * "9",
        ".".join(50_000 * "a") + " = 1",
        "[" + ".".join(50_000 * "a") + "]",
    ],
)
def test_text_that_is_no_toml_is_refused(text: str) -> None:
    assert refused(text).startswith("invalid TOML")


@given(
    above=st.lists(
        st.sampled_from(
            ["[s];[V];[um]", "record 17", "[data]", "t;u;x", "# a", "", "[ms] [V] [um]"]
        ),
        max_size=8,
    ),
    row=st.sampled_from(
        ["0.1;2.5;3", "-1e-3\t4,5\t6", " 1.5D+00  2  3", '"1";"2";"3"', "2026-03-03T11:59;1;2;good"]
    ),
    suffix=st.sampled_from(["csv", "txt", "toml", ""]),
)
def test_a_record_is_no_config_whatever_is_above_its_numbers(
    tmp_path_factory: pytest.TempPathFactory, above: list[str], row: str, suffix: str
) -> None:
    path = tmp_path_factory.getbasetemp() / f"a.{suffix}"
    path.write_text("\n".join([*above, *20 * [row]]))
    assert not is_config(path)
    path.write_text(RECORD + "# 1\n\n[model]\nexponent = 2\n")
    assert is_config(path)


def test_what_is_no_file_or_too_large_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "utf16.toml").write_bytes(b"\xff\xfe[\0r\0")
    (tmp_path / "large.toml").write_text(RECORD + 1_000_000 * "#")
    for path, why in (
        (tmp_path / "pipe", "not a regular file"),
        (Path("/dev/zero"), "not a regular file"),
        (tmp_path / "large.toml", "larger than 1 MB"),
        (tmp_path / "utf16.toml", "is not UTF-8 text"),
        (tmp_path / "none.toml", r"none\.toml: No such file"),
        (tmp_path, re.escape(f"{tmp_path}: Is a directory")),
    ):
        with pytest.raises(InputError, match=why):
            load(path)


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "runs").glob("*.toml")))
def test_the_runs_that_come_with_the_package_can_be_read(path: Path) -> None:
    config = load(path)
    assert parse(dump(config), "again") == config


# Models in a line are what a config would say of them, and what cannot be read is one line

BASE = ModelConfig(
    nonlinearity=["cubic"],
    creep=True,
    dynamics="none",
    hold="first",
    history="demagnetized",
    passive=False,
)


def test_what_is_said_is_taken_and_the_rest_is_the_configs() -> None:
    text = "bouc-wen; maxwell-slip(thresholds=4)+quadratic +cubic; linear + creep + lag + white;"
    models = models_of(text, BASE)
    assert list(models) == [
        "bouc-wen",
        "maxwell-slip(thresholds=4) + quadratic + cubic",
        "linear + creep + lag + white",
    ]
    first, second, third = models.values()
    assert first == ModelConfig(dynamics="none", hold="first", history="demagnetized", stages=[])
    assert (second.hysteresis, second.thresholds) == ("maxwell-slip", 4)
    assert second.nonlinearity == ["quadratic", "cubic"]
    assert (third.creep, third.dynamics, third.noise) == (True, "lag", "white")


def test_a_model_in_a_line_may_have_parts_from_outside() -> None:
    noise, stage = "bwbayes.inference.noise:SmoothNoise", "bwbayes.model.stages.lags:Delay"
    (model,) = models_of(f"linear + {stage} + {noise} + student", BASE).values()
    assert (model.stages, model.noise) == ([stage], f"{noise} + student")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("bouc-wenn", "did you mean bouc-wen?"),
        ("bouc-wen + quadratik", "did you mean quadratic?"),
        ("plays(treshold=4)", "treshold is unknown"),
        ("plays(thresholds=)", "write options as in thresholds=4"),
        ("plays(thresholds='x')", "thresholds"),
        ("bouc-wen; bouc-wen", "is there twice"),
        (" ; ", "names no model"),
        ("+ quadratic", "begin with an operator"),
        ("linear + pathlib:Pat", "cannot import 'pathlib:Pat'"),
    ],
)
def test_what_cannot_be_read_is_refused_in_a_line(text: str, said: str) -> None:
    with pytest.raises(InputError, match="models: ") as refused:
        models_of(text, BASE)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


# ``bwbayes config`` and ``bwbayes models`` print what is true of every key and every part.
# The reference is made from the config's models and from the parts, so what is tested is that
# nothing is missing from them, and that every example is a config.


EVERY = {key.path: key for key in keys(Config)}
LEAVES = {path: key for path, key in EVERY.items() if key.table is None}
every_part = pytest.mark.parametrize("name", [n for makers in PARTS.values() for n in makers])

# Other keys that an example needs to be a config.
WITH = {
    "parameters.NAME": "",
    "validation.NAME": "window = [1.0, 2.0]",
    "validation.NAME.signal": "amplitude = 1.0\nfrequency = 1.0\nduration = 9.0",
    "record": 'file = "a.csv"',
    "record.signal": "amplitude = 1.0\nfrequency = 1.0\nduration = 9.0",
}


def config_with(key: Key) -> str:
    table = key.path.rpartition(".")[0]
    beside = [line for line in WITH.get(table, "").splitlines() if line.split()[0] != key.name]
    example = f"{key.name} = {key.example}"
    if key.name in ("levels", "dwell"):
        beside = ['shape = "steps"', "duration = 9.0", "levels = [1.0]", "dwell = 1.0"]
        beside = [line for line in beside if line.split()[0] != key.name]
    if key.name == "signal":
        beside = []
    if key.path == "validation.NAME.lead_in_start":
        beside = ['file = "b.csv"']
    if key.path == "record.outliers":
        beside = ['file = "a.csv"']
    lines = [f"[{table.replace(ANY, 'd')}]", *beside, example] if table else [example]
    if not table.startswith("record"):
        lines += ["[record]", WITH["record"]]
    return "\n".join(lines) + "\n"


def test_the_example_of_a_key_is_a_config() -> None:
    """And the key has a meaning there, other than its default."""
    for path, key in LEAVES.items():
        text = config_with(key)
        config = parse(text, "example.toml")
        plain = text.replace(f"{key.name} = {key.example}\n", "")
        if key.default not in ("required", "none"):
            assert config != parse(plain, "plain.toml"), path


def test_a_key_of_a_default_that_is_printed_has_that_default() -> None:
    config = parse('[record]\nfile = "a.csv"\n[validation.d]\nwindow = [0.0, 1.0]', "plain.toml")
    for path, key in LEAVES.items():
        if key.default in ("required", "none") or "signal" in path.split("."):
            continue
        value: object = config.model_dump()
        for part in path.split("."):
            assert isinstance(value, dict)
            value = value["d" if part == ANY else part]
        assert tomllib.loads(f"x = {key.default}")["x"] == value, path


def test_the_whole_reference_names_every_key_once_and_no_other() -> None:
    text = config_reference(None)
    shown = re.findall(r"^(?:\[(\S+)\]|(\S+): )", text, flags=re.MULTILINE)
    paths = [table or key for table, key in shown]
    assert len(paths) == len(set(paths))
    repeated = {path for path in EVERY if path.startswith("validation.NAME.signal.")}
    assert set(EVERY) - repeated == set(paths)


@pytest.mark.parametrize(
    ("asked", "shown"),
    [
        ("ess", {"sampling.ess"}),
        ("sampling.ess", {"sampling.ess"}),
        ("parameters.d.prior", {"parameters.NAME.prior"}),
        ("validation.held_out.window", {"validation.NAME.window"}),
        ("window", {"validation.NAME.window"}),
        ("from_rest", {"record.from_rest", "validation.NAME.from_rest"}),
        ("stand", {path for path in EVERY if path.split(".")[0] == "stand"}),
        ("parameters", {path for path in EVERY if "parameters" in path.split(".")}),
    ],
)
def test_a_key_is_asked_for_by_its_name_or_path(asked: str, shown: set[str]) -> None:
    text = config_reference(asked)
    said = re.findall(r"^(?:\[(\S+)\]|(\S+): )", text, flags=re.MULTILINE)
    assert shown == {table or key for table, key in said}


@pytest.mark.parametrize(
    ("asked", "hint"),
    [("es", "did you mean ess?"), ("draws", "did you mean ess?"), ("record.trian", "mean train?")],
)
def test_a_key_that_does_not_exist_is_one_line_with_the_nearest(asked: str, hint: str) -> None:
    with pytest.raises(InputError, match=re.escape(hint)):
        config_reference(asked)


@every_part
def test_a_part_has_a_line_and_a_page_with_its_parameters(name: str) -> None:
    (line,) = re.findall(rf"^  {name} +(\S.*)$", parts_reference(None), flags=re.MULTILINE)
    page = parts_reference(name)
    assert line.split(".")[0] in " ".join(page.split())
    makers = next(makers for makers in PARTS.values() if name in makers)
    part = makers[name]()
    declared = part.declarations if hasattr(part, "declarations") else part.parameters
    for one in declared:
        assert one.name in page or re.search(r"_\d+$", one.name)
        assert one.description.split(",")[0][:30] in " ".join(page.split()) or one.name[-1] != "1"
    assert "=" in page or name == "white"
    assert not re.search(r"``|:\w+:`|-----", page)
    assert max(map(len, page.splitlines())) <= 100


def test_a_part_that_does_not_exist_is_one_line_with_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean preisach"):
        parts_reference("presach")


def test_a_part_from_outside_is_described_by_its_import_path() -> None:
    page = parts_reference("bwbayes.model.operators.preisach:Preisach")
    assert "saturation" in page

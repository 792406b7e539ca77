"""``bwbayes config`` and ``bwbayes models`` print what is true of every key and every part.

The reference is made from the config's models and from the parts, so what is tested is that nothing
is missing from them, and that every example is a config.
"""

import re
import tomllib

import pytest

from bwbayes.app.config.config import PARTS, Config, config_reference, parse, parts_reference
from bwbayes.app.config.keys import ANY, Key, keys
from bwbayes.errors import InputError

EVERY = {key.path: key for key in keys(Config)}
LEAVES = {path: key for path, key in EVERY.items() if key.table is None}
every_part = pytest.mark.parametrize("name", [n for makers in PARTS.values() for n in makers])

# What an example needs beside it to be a config.
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

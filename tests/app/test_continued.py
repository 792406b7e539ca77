"""A record in several files is the record in one: the same windows, priors and log density.

Taken for records of their own, which is the twin, they say something else: the second half then has
an unknown start, and a discrepancy that knows nothing of the first half's.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise, permutations
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from bwbayes.app.fit.calls import config_of
from bwbayes.app.fit.fitted import Run
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError
from bwbayes.inference.engine import Engine
from bwbayes.record import Record, write_record

ENGINES = get_args(Engine)
SAMPLES, INTERVAL = 300, 0.02


def whole(seed: int = 1) -> Record:
    """Return a record that starts in motion, with a slow discrepancy and two missing readings."""
    source = np.random.default_rng(seed)
    time = INTERVAL * np.arange(SAMPLES)
    voltage = 80 * np.cos(2 * np.pi * 0.7 * time) * (1 - 0.1 * time)
    displacement = 0.6 * voltage + 3 + np.cumsum(0.1 * source.normal(size=SAMPLES))
    displacement += 0.2 * source.normal(size=SAMPLES)
    displacement[[40, 200]] = np.nan
    return Record(voltage, displacement, interval=INTERVAL)


def parts(record: Record, *cuts: int, own_clock: bool = False) -> list[Record]:
    edges = [0, *cuts, record.samples]
    made = [record.window(INTERVAL * first, INTERVAL * last) for first, last in pairwise(edges)]
    return [replace(one, start=0.0) if own_clock else one for one in made]


def problem(record: Any, **keys: Any) -> Run:
    config, records = config_of(record, keys)
    return resolve_config(config, Path(), records)


def densities(made: Run) -> np.ndarray[Any, Any]:
    z = np.random.default_rng(2).standard_normal((5, len(made.study.posterior.names)))
    return made.study.posterior.log_density(z)


def chained(named: Mapping[str, Record], **first: Any) -> dict[str, dict[str, Any]]:
    names = list(named)
    tables: dict[str, dict[str, Any]] = {names[0]: {"record": named[names[0]], **first}}
    for before, name in pairwise(names):
        tables[name] = {"record": named[name], "continues": before}
    return tables


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("own_clock", [False, True])
def test_halves_that_follow_at_once_are_the_whole(engine: Engine, own_clock: bool) -> None:
    record = whole()
    one = problem(record, engine=engine)
    first, second = parts(record, 170, own_clock=own_clock)
    two = problem(chained({"first": first, "second": second}), engine=engine)
    assert ["first"] == [*two.study.records]
    assert one.study.posterior.names == two.study.posterior.names
    assert one.study.sha256 == two.study.sha256
    assert {n: str(p) for n, p in one.study.defaults.items()} == {
        n: str(p) for n, p in two.study.defaults.items()
    }
    np.testing.assert_allclose(densities(two), densities(one), rtol=1e-10)


def test_records_of_their_own_are_something_else() -> None:
    """The twin: even with offset and initial state shared."""
    record = whole()
    one = problem(record)
    first, second = parts(record, 170)
    keys = {"shared": ["initial", "offset"]}
    two = problem({"first": first, "second": second}, **keys)
    assert one.study.posterior.names == two.study.posterior.names
    assert np.abs(densities(two) - densities(one)).min() > 0.1


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_windows_and_what_is_held_out_are_those_of_the_whole(order: tuple[int, ...]) -> None:
    """In three files, listed in any order, each with a clock of its own."""
    record = whole()
    held = {"late": (4.2, 5.0)}
    one = problem(record, train=[(0.5, 2.0), (2.6, 4.0), (5.0, 6.0)], validation=held, start=0.6)
    made = parts(record, 100, 200, own_clock=True)
    tables = chained(dict(zip("abc", made, strict=True)), train=[(0.5, 2.0)], start=0.6)
    tables["b"]["train"] = [(0.6, 2.0)]
    tables["c"]["train"] = [(1.0, 2.0)]
    listed = {"abc"[i]: tables["abc"[i]] for i in order}
    validation = {"late": {"window": (0.2, 1.0), "of": "c"}}
    three = problem(listed, validation=validation)
    assert (
        one.study.posterior.single_record.training == three.study.posterior.single_record.training
    )
    assert one.study.validations["late"].windows == three.study.validations["late"].windows
    np.testing.assert_allclose(densities(three), densities(one), rtol=1e-10)


def test_a_continued_record_beside_another(tmp_path: Path) -> None:
    record, other = whole(), whole(2)
    named = dict(zip(("a", "b"), parts(record, 120), strict=True)) | {"other": other}
    for name, one in named.items():
        write_record(one, tmp_path / f"{name}.h5")
    files = {name: tmp_path / f"{name}.h5" for name in named}
    tables = {
        "a": {"record": files["a"], "outliers": [0.5]},
        "b": {"record": files["b"], "continues": "a", "outliers": [3.5]},
        "other": {"record": files["other"]},
    }
    made = problem(tables, per_record=["sensor_sd"])
    assert ["a", "other"] == [*made.study.records]
    assert {"offset[a]", "offset[other]", "sensor_sd[other]"} <= {*made.study.posterior.names}
    assert made.config.records["a"].outliers == [0.5, 3.5]
    assert made.config.records["a"].continues is None
    assert made.study.records["a"].origin == "a.h5, then b.h5"
    table = {"record": record, "outliers": [0.5, 3.5]}
    both = problem({"a": table, "other": other}, per_record=["sensor_sd"])
    np.testing.assert_allclose(densities(made), densities(both), rtol=1e-10)


def second(**changes: Any) -> Record:
    return replace(parts(whole(), 170)[1], **changes)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"b": {"continues": "c"}}, r"record\.b\.continues: no other record 'c'; known are a"),
        ({"b": {"continues": "b"}}, r"record\.b\.continues: no other record 'b'; known are a"),
        ({"a": {"continues": "b"}}, r"continues: a circle \([ab], [ab], [ab]\); one is the first"),
        ({"c": {"continues": "a"}}, r"record\.c\.continues: b continues a too; one record can"),
        ({"b": {"from_rest": True}}, r"record\.b\.continues: it starts where a ends; remove its f"),
        (
            {"b": {"record": second(interval=0.05)}},
            r"record\.b\.continues: sampled every 0\.05 s, a every 0\.02 s; remove it",
        ),
        (
            {"b": {"record": second(voltage_is="command")}},
            r"record\.b\.continues: its voltage is the command, that of a the output; see voltage",
        ),
        ({"a": {"stop": 2.0}}, r"record\.b\.continues: a is cut by its stop; remove one of them"),
        (
            {"b": {"record": second(start=4.0)}},
            r"record\.b\.continues: begins at 4 s, a ends at 3\.4 s; a record can only be contin",
        ),
        ({"b": {"record": second(start=2.0)}}, r"begins at 2 s, a ends at 3\.4 s"),
    ],
)
def test_what_cannot_continue_is_refused_in_one_line(
    tables: dict[str, dict[str, Any]], message: str
) -> None:
    first, other = parts(whole(), 170)
    usual = chained({"a": first, "b": other})
    if "c" in tables:
        usual["c"] = {"record": whole(2)}
    given = {name: usual[name] | tables.get(name, {}) for name in usual}
    with pytest.raises(InputError, match=message) as raised:
        problem(given)
    assert "\n" not in str(raised.value)


def test_one_record_alone_continues_nothing_and_neither_does_a_signal() -> None:
    with pytest.raises(InputError, match=r"record\.continues: no other record 'a'; remove it"):
        problem(whole(), continues="a")
    from bwbayes.app.config.config import parse  # noqa: PLC0415

    text = '[record.a]\nsignal = "step10"\n[record.b]\nsignal = "step10"\ncontinues = "a"\n'
    with pytest.raises(InputError, match="the stand starts every signal at rest; give files"):
        resolve_config(parse(text, "two.toml"), Path())

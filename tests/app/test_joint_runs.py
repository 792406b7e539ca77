"""Several records in one config, or one in several files: read, refused, run and predicted."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise, permutations
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

import bwbayes
from bwbayes.app.config.config import parse
from bwbayes.app.config.keywords import config_of
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.calibrate import experiment
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.app.study.resolve import resolve_config
from bwbayes.calibration.calibration import replicate
from bwbayes.errors import InputError
from bwbayes.inference import Engine
from bwbayes.record import Record, write_record
from bwbayes.report.figures import pictures
from tests.app import small

# A loop and a step at another rate than its readings', on one stand.
TEXT = """\
seed = 3

[record.loops]
signal = { amplitude = 100.0, frequency = 1.0, duration = 4.0, decay = 0.2, decay_from = 0.5 }
from_rest = true
train = [[0.0, 3.0]]

[record.step]
signal = { shape = "steps", levels = [60.0], dwell = 2.0, start = 0.5, duration = 2.0 }
from_rest = true
decimate = 2

[stand]
sample_rate = 50.0

[model]
dynamics = "none"

[parameters]
gamma = { fixed = 0.0172 }

[sampling]
ess = 150
block = 25
walkers = 20

[validation.later]
of = "loops"
window = [3.0, 4.0]

[validation.sine]
signal = { amplitude = 60.0, frequency = 0.5, duration = 3.0 }
from_rest = true
"""


def problem(*changes: tuple[str, str]) -> Run:
    return resolve_config(small.config(*changes, text=TEXT), Path())


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    path = tmp_path_factory.mktemp("joint") / "run"
    folder = RunFolder.create(path, resolve_config(parse(TEXT, "joint.toml"), path.parent))
    with pytest.MonkeyPatch.context() as patch:
        small.without_explanations(patch)
        resume(folder, small.quiet(), workers=1)
    return folder


def test_default_priors_and_the_spans_of_parts_come_from_all_records() -> None:
    """The loop has the widest range and turns; an offset's prior is from its own record."""
    changes = ('dynamics = "none"', 'dynamics = "none"\nnonlinearity = ["quadratic"]')
    both = problem(changes, ("ess = 150", "ess = 151"))
    lone = TEXT[: TEXT.index("[record.step]")] + TEXT[TEXT.index("[stand]") :]
    lone = lone.replace("[record.loops]", "[record]").replace('of = "loops"\n', "")
    _, head, tail = lone.replace(*changes).partition("[record]\n")
    text = f'{head}file = "loops.h5"\n{tail.partition(chr(10))[2]}'
    alone = resolve_config(parse(text, ""), Path(), {"record": both.study.records["loops"]})
    shared = [name for name in alone.study.defaults if name in both.study.defaults]
    assert {"d", "alpha", "sensor_sd"} <= {*shared}
    assert {n: alone.study.defaults[n] for n in shared} == {
        n: both.study.defaults[n] for n in shared
    }
    assert both.study.defaults["offset[step]"] != both.study.defaults["offset[loops]"]
    spans = {one.actuator.span for one in both.study.posterior.datasets}
    assert len(spans) == 1
    assert next(iter(spans)).low < -50  # type: ignore[union-attr]


def test_a_run_shows_each_record_by_its_name(finished: RunFolder) -> None:
    numbers = json.loads(finished.summary.read_text())
    assert {"loops", "step", "later", "sine"} == numbers["validation"].keys()
    assert {"loops", "step"} == numbers["innovations"].keys() == numbers["agreement"].keys()
    assert all(one["agrees"] for one in numbers["agreement"].values())
    made = bwbayes.open_run(finished.path)
    assert {"step"} <= made.step_responses.keys()
    drawn = {path.stem for path in (finished.path / "figures").glob("*.png")}
    assert drawn == pictures(made.result).keys()
    assert {"agreement", "bands_loops", "bands_step", "innovations_step"} <= drawn
    page = (finished.path / "report.html").read_text()
    assert "Consistency of the records" in page
    assert "offset[step]" in page
    tree = made.posterior
    assert {"displacement_loops", "displacement_step"} == {*tree["observed_data"].data_vars}
    assert tree["observed_data"]["time_step"].size == 100
    step = made.plot.record(name="step")
    assert len(step.axes) >= 2
    with pytest.raises(InputError, match=r"residuals: of several records; take fit\.bands"):
        _ = made.residuals


@pytest.mark.usefixtures("_without_pictures")
def test_a_chain_of_several_records_goes_on_and_knows_its_own(
    finished: RunFolder, tmp_path: Path
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(finished.path, copy)
    resume(RunFolder(copy), small.quiet(), workers=1)
    small.assert_same_end(finished.path, copy)
    text = (copy / "config.toml").read_text()
    (copy / "config.toml").write_text(text.replace("train = [[0.0, 3.0]]", "train = [[0.0, 2.9]]"))
    with pytest.raises(InputError, match=r"record\.loops\.train was"):
        resume(RunFolder(copy), small.quiet(), workers=1)
    (copy / "config.toml").write_text(text)
    (copy / "records/step.h5").replace(copy / "records/loops.h5")
    with pytest.raises(InputError):
        resume(RunFolder(copy), small.quiet(), workers=1)


def test_replicates_make_all_records_anew() -> None:
    common = experiment(problem(("ess = 150", "ess = 100")))
    assert ["loops"] == [*common.held_out]
    entry = replicate(common, 1, 0).entry
    assert entry["converged"]
    assert {"offset[loops]", "offset[step]", "loop_area", "d"} <= entry["truth"].keys()
    assert {"sensor 95", "sine sensor 95"} <= entry["covered"].keys()


def measured(seed: int, gain: float = 0.6) -> Record:
    time = np.arange(100) / 50
    voltage = 80 * np.sin(2 * np.pi * time)
    noise = np.random.default_rng(seed).standard_normal(100)
    return Record.from_arrays(voltage, gain * voltage + 0.3 * noise, interval=0.02)


def test_python_takes_a_list_or_a_dict_of_records(tmp_path: Path) -> None:
    one, two = measured(1), measured(2)
    made, records = config_of([one, two], {"train": (0, 1), "dynamics": "none"})
    assert ["record_1", "record_2"] == [*made.records] == [*records]
    assert [[0.0, 1.0]] == made.records["record_2"].train
    write_record(two, tmp_path / "later.h5")
    table = {"first": one, "second": {"record": tmp_path / "later.h5", "train": (0.5, 1.5)}}
    made, records = config_of(table, {"train": (0, 1)})
    assert ["first"] == [*records]
    assert [[[0.0, 1.0]], [[0.5, 1.5]]] == [given.train for given in made.records.values()]
    assert 2 == len(resolve_config(made, Path(), records).study.records)
    with pytest.raises(InputError, match="two records are called 'later'; give a dict"):
        config_of([tmp_path / "later.h5", tmp_path / "later.h5"], {})
    nothing: list[Any] = [[], {}, 3, [3]]
    for given in nothing:
        with pytest.raises(InputError, match="make one with Record"):
            config_of(given, {})


LONE = '[record.a]\nfile = "a.h5"\n'
HELD = "[validation.v]\nwindow = [0.0, 1.0]\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LONE + '[record]\nfile = "b.h5"', "Cannot declare|train|file is a key of one record"),
        (LONE + "trian = [0.0, 1.0]", "record.a.trian: unknown key; did you mean train"),
        (LONE + '[record.training]\nfile = "b.h5"', "the name 'training' of a record is taken"),
        (LONE + '[record.b]\nfile = "b.h5"\n[validation.a]\nfile = "c.h5"', "'a' is taken by a"),
        (
            LONE + f'[record.b]\nfile = "b.h5"\n{HELD}',
            'its window is of one .*, of = "a" for instance',
        ),
        (LONE + f'{HELD}of = "b"', "validation.v.of: no training record 'b'"),
    ],
)
def test_configs_of_several_records_that_say_too_much_or_too_little_are_refused(
    text: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        parse(text, "joint.toml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "[[0.0, 3.0]]",
            "[[9.0, 10.0]]",
            r"^record\.loops\.train: window 9 to 10 s: reaches outside",
        ),
        (
            "decimate = 2",
            "start = 1.0\ntrain = [[0.0, 0.8]]",
            r"no readings .* in \[record\.step\]",
        ),
        ("[model]", "[model]\nper_record = ['creep_1']", "per_record: no part here has 'creep_1'"),
        (
            "gamma =",
            '"offset[stp]" =',
            r"\[stp\]: no such parameter here; did you mean offset\[step",
        ),
    ],
)
def test_what_several_records_cannot_be_is_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        problem((old, new))


def test_readings_do_not_count_twice(tmp_path: Path) -> None:
    write_record(measured(1), tmp_path / "a.h5")
    text = '[record.a]\nfile = "a.h5"\n[record.b]\nfile = "a.h5"\n'
    with pytest.raises(InputError, match=r"^record\.b: the same measurement as record\.a, whose"):
        resolve_config(parse(text, ""), tmp_path)
    apart = text.replace("[record.b]", "train = [0.0, 1.0]\n[record.b]") + "train = [1.0, 2.0]\n"
    assert 2 == len(resolve_config(parse(apart, ""), tmp_path).study.records)


# A record in several files is the record in one: the same windows, priors and log density.
# Taken for records of their own, which is the twin, they say something else: the second half then
# has an unknown start, and a discrepancy that knows nothing of the first half's.


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


def continued(record: Any, **keys: Any) -> Run:
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
    one = continued(record, engine=engine)
    first, second = parts(record, 170, own_clock=own_clock)
    two = continued(chained({"first": first, "second": second}), engine=engine)
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
    one = continued(record)
    first, second = parts(record, 170)
    keys = {"shared": ["initial", "offset"]}
    two = continued({"first": first, "second": second}, **keys)
    assert one.study.posterior.names == two.study.posterior.names
    assert np.abs(densities(two) - densities(one)).min() > 0.1


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_windows_and_what_is_held_out_are_those_of_the_whole(order: tuple[int, ...]) -> None:
    """In three files, listed in any order, each with a clock of its own."""
    record = whole()
    held = {"late": (4.2, 5.0)}
    one = continued(record, train=[(0.5, 2.0), (2.6, 4.0), (5.0, 6.0)], validation=held, start=0.6)
    made = parts(record, 100, 200, own_clock=True)
    tables = chained(dict(zip("abc", made, strict=True)), train=[(0.5, 2.0)], start=0.6)
    tables["b"]["train"] = [(0.6, 2.0)]
    tables["c"]["train"] = [(1.0, 2.0)]
    listed = {"abc"[i]: tables["abc"[i]] for i in order}
    validation = {"late": {"window": (0.2, 1.0), "of": "c"}}
    three = continued(listed, validation=validation)
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
    made = continued(tables, per_record=["sensor_sd"])
    assert ["a", "other"] == [*made.study.records]
    assert {"offset[a]", "offset[other]", "sensor_sd[other]"} <= {*made.study.posterior.names}
    assert made.config.records["a"].outliers == [0.5, 3.5]
    assert made.config.records["a"].continues is None
    assert made.study.records["a"].origin == "a.h5, then b.h5"
    table = {"record": record, "outliers": [0.5, 3.5]}
    both = continued({"a": table, "other": other}, per_record=["sensor_sd"])
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
        continued(given)
    assert "\n" not in str(raised.value)


def test_one_record_alone_continues_nothing_and_neither_does_a_signal() -> None:
    with pytest.raises(InputError, match=r"record\.continues: no other record 'a'; remove it"):
        continued(whole(), continues="a")
    from bwbayes.app.config.config import parse  # noqa: PLC0415

    text = '[record.a]\nsignal = "step10"\n[record.b]\nsignal = "step10"\ncontinues = "a"\n'
    with pytest.raises(InputError, match="the stand starts every signal at rest; give files"):
        resolve_config(parse(text, "two.toml"), Path())

"""Several records in one config: what is read, refused, run, continued and predicted."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes
from bwbayes.app.config.config import parse
from bwbayes.app.fit.calls import config_of
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.calibrate import experiment
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.app.study.resolve import resolve_config
from bwbayes.calibration.calibration import replicate
from bwbayes.errors import InputError
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

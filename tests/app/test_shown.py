"""Objects show little at a prompt, ``dir`` public names alone, and docstrings no inner modules."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import bwbayes as bw
from bwbayes.app.config.config import parse
from bwbayes.app.jobs.campaign import Row
from bwbayes.app.running.folder import CampaignFolder
from bwbayes.control.loop import Stand
from bwbayes.control.tracking import Tracking, track
from bwbayes.model.inputs import Limits
from bwbayes.population.population import population
from bwbayes.shown import LONGEST, MOST_LINES, brief, rounded
from tests.control import cases
from tests.population.test_population import drawn


@pytest.fixture(scope="module")
def objects(fit: bw.Run, tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    folder, rng = tmp_path_factory.mktemp("shown"), np.random.default_rng(1)
    time = np.arange(300) / 50
    voltage = 60 * np.sin(2 * np.pi * time) * (1 - time / 20)
    stand = bw.VirtualTestStand(sample_rate=50.0)
    record = stand.run(voltage, rng)
    rows = tuple(Row(f"r{i}", f"r{i}.csv", "refused", "because " * 40, {}) for i in range(200))
    many = population(drawn(rng).specimens, rng)
    return [
        fit,
        record,
        stand,
        bw.Record.from_arrays(np.sin(np.arange(1000)), interval=1e-3),
        bw.signal("identification"),
        bw.InputError("a"),
        bw.InputWarning("a"),
        bw.NotConvergedError("a"),
        *bw.inspect(bw.Record(voltage, -voltage, interval=0.02)),
        fit.predict(record, lead_in=0.2),
        *fit.predictions,
        bw.Campaign(CampaignFolder(folder), rows, many),
        fit.compensate("sine", amplitude=20, frequency=1, from_rest=True),
        fit.export(folder / "export"),
        followed(rng),
        *fit.design("d", candidates={"fast": voltage, "slow": 0.5 * voltage}),
        bw.compare(fit, fit, future=False, workers=1),
        parse('[record]\nfile = "a.csv"\n', "a"),
    ]


def followed(generator: np.random.Generator) -> Tracking:
    """Return what ``fit.track`` does, of three draws: the margins of a thousand take a minute."""
    actuator = cases.actuator("bouc-wen, second-order", "zero")
    noise = cases.noise_of(3, 0.5, 1.5, 0.5)
    theta, stand = cases.theta(actuator, 3), Stand(Limits(*cases.SPAN))
    return track(actuator, theta, noise, stand, generator, frequencies=(5.0,))


@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_every_object_shows_itself_in_a_dozen_lines(objects: list[Any]) -> None:
    public = {getattr(bw, name) for name in bw.__all__ if isinstance(getattr(bw, name), type)}
    assert not {one.__name__ for one in public - {*map(type, objects)}}
    for thing in objects:
        text = repr(thing)
        assert text.count("\n") < MOST_LINES, type(thing)
        assert len(text) <= LONGEST, type(thing)


def test_what_is_printed_is_still_whole(objects: list[Any]) -> None:
    fit = objects[0]
    assert len(str(fit).splitlines()) > MOST_LINES
    assert str(fit).startswith("small: converged, ")
    first, last = repr(fit).splitlines()[0], repr(fit).splitlines()[-1]
    assert str(fit).startswith(first)
    assert re.fullmatch(r"\.\.\. \d+ more lines: print it to see them", last)


@dataclass(frozen=True)
class Anything:
    """With fields of any kind."""

    __repr__ = brief

    one: Any
    another: Any


VALUES = st.recursive(
    st.none() | st.text() | st.floats() | st.integers() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner, inner),
)


@given(VALUES, VALUES)
def test_anything_is_shown_shortly(one: Any, another: Any) -> None:
    for thing in (Anything(one, another), Anything(Anything(one, another), [one] * 50)):
        assert repr(thing).count("\n") < MOST_LINES
        assert len(repr(thing)) <= LONGEST


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (13612.0, 3, "13,600"),
        (670.4, 2, "670"),
        (41.26, 3, "41.3"),
        (0.0012, 2, "0.0012"),
        (2.5e7, 3, "2.5e+07"),
        (99_990.0, 2, "100,000"),
    ],
)
def test_a_number_has_no_exponent_below_a_million(value: float, digits: int, text: str) -> None:
    assert rounded(value, digits) == text


def test_dir_has_public_names_alone() -> None:
    assert sorted(bw.__all__) == dir(bw)

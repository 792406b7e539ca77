"""Pictures that another process draws are those that this one draws, whatever comes of it."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest

from bwbayes.app.running.figure_worker import Artist, artist_of
from bwbayes.report.figures import picture_of, plots_of, save_pictures
from bwbayes.report.figures.pictures import pictures
from bwbayes.report.page import NO_PLOTS
from tests.app import example


class Broken(Executor):
    """Loses its processes at every call."""

    def submit(self, _: Callable[..., Any], /, *__: Any, **___: Any) -> Future[Any]:
        """Return what has failed already."""
        future: Future[Any] = Future()
        future.set_exception(BrokenProcessPool())
        return future


def test_another_process_draws_the_same_pictures_in_the_same_order(tmp_path: Path) -> None:
    run = example.run()
    with artist_of(2) as artist:
        if artist.pool is None:
            pytest.skip("this machine has one core")
        artist.draw(dataclasses.replace(run, bands=(), scores={}, innovations={}))
        artist.draw(dataclasses.replace(run, scores={}))
        drawn, plots = artist.drawn(run, tmp_path / "apart")
    here = {name: picture_of(picture.draw) for name, picture in pictures(run).items()}
    save_pictures(here, tmp_path / "here")
    assert list(here.items()) == list(drawn.items())
    assert plots_of(run).drawn == plots.drawn
    assert {path.name: path.read_bytes() for path in (tmp_path / "here").iterdir()} == {
        path.name: path.read_bytes() for path in (tmp_path / "apart").iterdir()
    }


def test_without_convergence_there_are_the_chains(tmp_path: Path) -> None:
    """Also where the process that was to draw them has died, and nothing was begun."""
    artist, run = Artist(Broken()), example.run(converged=False)
    drawn, plots = artist.drawn(run, tmp_path)
    assert plots == NO_PLOTS
    assert ["trace", "ranks"] == list(drawn)
    assert {"trace.png", "ranks.png"} == {path.name for path in tmp_path.iterdir()}


def test_pictures_outlive_the_process_that_was_to_draw_them(tmp_path: Path) -> None:
    artist, run = Artist(Broken()), example.run()
    artist.draw(run)
    assert list(pictures(run)) == list(artist.drawn(run, tmp_path)[0])

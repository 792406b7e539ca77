"""Ten thousand spoilt configs and records: each is used, or refused in one line.

Every case goes through ``bwbayes check`` in this process. What is used must give finite numbers,
and make a run's folder that reads back the same, with nothing written beside it. The best of some
prior draws stands in for the point fit, no misfit is explained and no page is drawn, which take
longer than all the rest, but for a few cases.

The default run takes the first 75, five of each kind, which find what befalls one case in 25 with a
probability of 0.95, and one noise; ``-m slow`` takes all, and chooses theirs. A case is made again
from its number: ``tests.app.mutations.case(SEED, number)``.
"""

import contextlib
import faulthandler
import io
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.commands import cli
from bwbayes.app.config.config import load
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs import check as app_check
from bwbayes.app.running import explaining
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import generator
from bwbayes.watching import Watch
from tests.app import small
from tests.app.mutations import KINDS, QUICK, Case, case, made
from tests.measured import keep

SEED = 1
FEW, ALL = 75, 10_000
SECONDS = 10  # of processor time, for a case that takes some hundredths
LONGEST_LINE = 700


class TooLate(BaseException):
    """The time of a case is over; no ``except Exception`` may take it for damage to a file."""


@dataclass(frozen=True)
class Said:
    """What the command said of a case, its exit status, and the processor time it took, s."""

    status: int
    out: str
    err: str
    seconds: float


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["bwbayes", "check", "my.toml"])
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


@pytest.fixture
def quick_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pointfit, "fit", best_draw)
    small.without_explanations(monkeypatch)
    monkeypatch.setattr(explaining, "explain", lambda *_, **__: ())
    monkeypatch.setattr(app_check, "save", lambda *_, **__: [])


def best_draw(
    posterior: Posterior, generator: np.random.Generator, _: Watch
) -> pointfit.MAPEstimate:
    """Stand in for the point fit, with its error for priors that the record contradicts."""
    prior = posterior.prior
    draws = prior.unconstrain(prior.draw(generator, 64))
    density = posterior.log_density(draws)
    if not np.isfinite(density).any():
        raise InputError("priors: no draw has a finite posterior density; check priors and record")
    best, spread = draws[np.argmax(density)], np.atleast_2d(np.cov(draws, rowvar=False))
    return pointfit.MAPEstimate(best, spread, float(density.max()), best[np.newaxis], spread)


def check(one: Case, place: Path, seconds: int = SECONDS) -> Said:
    """Type ``bwbayes check my.toml`` with the files of a case; a defect keeps its traceback."""
    (place / "my.toml").write_bytes(one.config)
    (place / one.record).write_bytes(one.data)
    out, err, status = io.StringIO(), io.StringIO(), None
    begun = time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), limited(seconds):
        try:
            cli.main()
        except SystemExit as end:
            status = end.code
    assert isinstance(status, int)
    said = small.without_progress(err.getvalue())
    return Said(status, out.getvalue(), said, time.process_time() - begun)


@contextlib.contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Raise after some seconds, and end the process if it hangs where Python cannot raise."""

    def late(*_: object) -> None:
        raise TooLate

    before = signal.signal(signal.SIGPROF, late), signal.getsignal(signal.SIGTERM)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    faulthandler.dump_traceback_later(30 * seconds, exit=True, file=sys.__stderr__ or 2)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGPROF, before[0])
        signal.signal(signal.SIGTERM, before[1])


def assert_used_or_refused(one: Case, said: Said, place: Path) -> None:
    assert {"my.toml", one.record} == {path.name for path in place.iterdir()}
    if said.status == 2:
        assert said.out == ""
        assert said.err.startswith("bwbayes: ")
        assert said.err.endswith("\n")
        assert said.err[:-1].isprintable()
        assert len(said.err) <= LONGEST_LINE
        assert "out of memory" not in said.err
    else:
        assert (0, "") == (said.status, said.err)
        assert "MAP estimate" in said.out
        assert_becomes_a_run(place)


def assert_becomes_a_run(place: Path) -> None:
    """Make the run's folder, and find the same numbers in it and nothing beside it."""
    problem = resolve_config(load(place / "my.toml"), place)
    before = {path.name for path in place.iterdir()}
    folder = RunFolder.create(place / "out", problem, overwrite=False)
    assert before | {"out"} == {path.name for path in place.iterdir()}
    again = Run(folder)
    assert again.config == problem.config
    assert again.study.record.sha256 == problem.study.record.sha256
    prior = problem.study.posterior.prior
    coordinates = prior.unconstrain(prior.draw(generator(1, "hostile"), 8))
    np.testing.assert_array_equal(
        problem.study.posterior.log_density(coordinates),
        again.study.posterior.log_density(coordinates),
    )
    free, _ = prior.constrain(coordinates)
    assert np.isfinite(problem.study.posterior.simulate(prior.theta(free))).all()
    shutil.rmtree(folder.path)


def spoilt(numbers: range, place: Path) -> dict[str, Counter[int]]:
    """Check the cases of these numbers; return how often each kind ended with each status."""
    result = {kind: Counter[int]() for kind in KINDS}
    slowest = (0.0, "")
    # Without a limit what is compiled is compiled now.
    assert check(Case("good", QUICK.encode(), "record.csv", made()["csv"]), place, 600).status == 0
    (place / "record.csv").unlink()
    for number in numbers:
        one = case(SEED, number)
        try:
            said = check(one, place)
            assert_used_or_refused(one, said, place)
        except BaseException as error:
            error.add_note(f"case({SEED}, {number}): {one.kind}")
            raise
        slowest = max(slowest, (said.seconds, f"case({SEED}, {number}), {one.kind}"))
        result[one.kind][said.status] += 1
        (place / one.record).unlink()
    print(f"slowest: {slowest[0]:.2f} s, {slowest[1]}")
    for kind, counts in result.items():
        print(f"{kind}: {counts[0]} used, {counts[2]} refused")
    return result


@pytest.mark.usefixtures("quick_fit")
def test_spoilt_inputs_are_used_or_refused_in_one_line(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(explaining, "chosen_noise", lambda *_: ("discrepancy", ""))
    result = spoilt(range(FEW), place)
    assert sum(counts[0] for counts in result.values()) > 0.1 * FEW, "hardly any is used"
    for kind, counts in result.items():
        assert counts[2] > 0, f"{kind}: nothing was refused"


@pytest.mark.slow
@pytest.mark.usefixtures("quick_fit")
def test_ten_thousand_spoilt_inputs_are_used_or_refused_in_one_line(place: Path) -> None:
    result = spoilt(range(ALL), place)
    used, refused = (sum(counts[status] for counts in result.values()) for status in (0, 2))
    keep("hostile input", {"used": used, "refused": refused})
    assert ALL == sum(counts.total() for counts in result.values())

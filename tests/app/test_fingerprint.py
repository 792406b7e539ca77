"""A chain knows the posterior it belongs to: an edited config is refused, in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bwbayes.app.commands.products import predict
from bwbayes.app.config.config import Config, dump, load, parse
from bwbayes.app.fit.fitted import finished
from bwbayes.app.problem.problem import Problem
from bwbayes.app.running import fingerprint as fingerprint_module
from bwbayes.app.running.fingerprint import fingerprint, require_own, version_remarks, versions
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import redraw, resume
from bwbayes.errors import InputError
from tests.app import small


@pytest.fixture(scope="module")
def problem(run: Path) -> Problem:
    return RunFolder(run).problem()


def require(problem: Problem, changed: Config) -> None:
    """Hold a config against the chain of a problem."""
    noted = {"data_sha256": problem.sha256, "posterior": fingerprint(problem)}
    require_own(replace(problem, config=changed), Path("x"), noted)


def with_d(config: Config, **changes: Any) -> Config:
    d = config.parameters["d"].model_copy(update=changes)
    return config.model_copy(update={"parameters": config.parameters | {"d": d}})


def resumed(folder: RunFolder) -> None:
    resume(folder, small.quiet(), workers=1)


def predicted(folder: RunFolder) -> None:
    small.typed(predict, folder.path, "--signal", "sine")


@pytest.mark.parametrize("use", [redraw, resumed, predicted])
def test_edited_prior_is_refused(copy: RunFolder, use: Callable[[RunFolder], object]) -> None:
    """It once moved the means of a finished chain: 0.693 +- 0.008 became 0.675 +- 0.010."""
    config = load(copy.config)
    prior = config.parameters["d"].prior
    assert prior is not None
    wider = with_d(config, prior=prior | {"sigma": 1.25 * float(prior["sigma"])})
    copy.config.write_text(dump(wider))
    with pytest.raises(InputError) as caught:
        use(copy)
    text = str(caught.value)
    assert "chain: parameters.d.prior was lognormal (" in text
    assert text.endswith("; undo the edit or start a new run")


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("[[0.0, 5.0]]", "[[0.0, 4.0]]", "record.train"),
        ('dynamics = "lag"', 'dynamics = "none"', "model.dynamics"),
        ('hold = "auto"', 'hold = "first"', "model.hold"),
        ("fixed = 0.0172", "fixed = 0.0173", "parameters.gamma.fixed"),
        ("seed = 3", "seed = 4", "seed"),
        ("block = 25", "block = 30", "sampling.block"),
    ],
)
def test_what_changes_the_posterior_is_named(
    problem: Problem, old: str, new: str, key: str
) -> None:
    text = dump(problem.config)
    assert old in text
    with pytest.raises(InputError, match=f"x: {key} was .* when the chain was sampled, is "):
        require(problem, parse(text.replace(old, new), ""))


def test_a_bound_and_all_else_that_differs_are_named(problem: Problem) -> None:
    config = problem.config
    white = {"seed": 5, "model": config.model.model_copy(update={"noise": "white"})}
    for changed, said in (
        (with_d(config, lower=0.5), r"parameters.d.lower was not set when .* is 0\.5; undo"),
        (config.model_copy(update=white), r"seed was 3 .*, is 5 \(also model.noise\); undo"),
    ):
        with pytest.raises(InputError, match=said):
            require(problem, changed)


def test_what_leaves_the_posterior_may_change(problem: Problem) -> None:
    sampling = {"ess": 9.0, "steps": 7, "pilot_steps": 9, "engine": "auto"}
    changes = {
        "name": "other",
        "sampling": problem.config.sampling.model_copy(update=sampling),
        "validation": {},
        "truth": {},
    }
    relabeled = with_d(problem.config, label="D", description="gain")
    require(problem, relabeled.model_copy(update=changes))


def test_chain_without_a_fingerprint_is_refused(copy: RunFolder) -> None:
    with np.load(copy.chain / "start.npz") as file:
        arrays = dict(file)
    text = json.loads(str(arrays["text"]))
    del text["attributes"]["posterior"]
    np.savez(copy.chain / "start.npz", allow_pickle=False, **arrays | {"text": json.dumps(text)})
    for use in (redraw, resumed):
        with pytest.raises(InputError, match=r"does not say which priors .* start a new run"):
            use(copy)


def test_other_versions_are_said(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noted = json.dumps({"numpy": "1.0", "scipy": "1.1", "gone": "3"})
    now = {"numpy": "1.0", "scipy": "1.2", "new": "1"}
    expected = "the chain was begun with other versions: scipy 1.1, now 1.2"
    assert (expected,) == version_remarks(noted, now)
    assert () == version_remarks(noted, {"numpy": "1.0"})
    assert not any("other versions" in r for r in finished(RunFolder(run)).result.remarks)
    installed = versions("numpy")
    monkeypatch.setattr(fingerprint_module, "versions", lambda _: installed | {"numpy": "99"})
    remarks = finished(RunFolder(run)).result.remarks
    (remark,) = [text for text in remarks if "other versions" in text]
    assert remark.endswith(", now 99")

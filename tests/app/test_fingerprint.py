"""A chain knows the posterior it belongs to: an edited config is refused, in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.commands.products import predict
from bwbayes.app.config.config import dump, load, parse
from bwbayes.app.fit.opening import finished
from bwbayes.app.problem.problem import resolve
from bwbayes.app.running import assembling, cache
from bwbayes.app.running.fingerprint import (
    fingerprint,
    require_same,
    version_remarks,
    versions,
)
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import redraw, resume
from bwbayes.errors import InputError
from tests.app import small


def wider(folder: RunFolder) -> None:
    """Make the prior of d wider, as a user would in an editor."""
    config = load(folder.config)
    d = config.parameters["d"]
    assert d.prior is not None
    sigma = float(d.prior["sigma"])
    changed = d.model_copy(update={"prior": d.prior | {"sigma": 1.25 * sigma}})
    parameters = config.parameters | {"d": changed}
    folder.config.write_text(dump(config.model_copy(update={"parameters": parameters})))


def resumed(folder: RunFolder) -> None:
    resume(folder, small.quiet(), workers=1)


def predicted(folder: RunFolder) -> None:
    small.typed(predict, folder.path, "--signal", "sine")


@pytest.mark.parametrize("use", [redraw, resumed, predicted])
def test_edited_prior_is_refused(copy: RunFolder, use: Callable[[RunFolder], object]) -> None:
    """It once moved the means of a finished chain: 0.693 +- 0.008 became 0.675 +- 0.010."""
    wider(copy)
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
def test_what_changes_the_posterior_is_named(run: Path, old: str, new: str, key: str) -> None:
    text = (run / "config.toml").read_text()
    if old not in text:  # the stand's hold
        old, new = new, old
    assert old in text
    changed = parse(text.replace(old, new), "")
    with pytest.raises(InputError, match=f"x: {key} was .* when the chain was sampled, is "):
        require_same(fingerprint(load(run / "config.toml")), changed, Path("x"))


@pytest.mark.parametrize("use", [redraw, resumed])
def test_chain_without_a_fingerprint_is_refused(
    copy: RunFolder, use: Callable[[RunFolder], object]
) -> None:
    with np.load(copy.chain / "start.npz") as file:
        arrays = dict(file)
    text = json.loads(str(arrays["text"]))
    del text["attributes"]["posterior"]
    np.savez(copy.chain / "start.npz", allow_pickle=False, **arrays | {"text": json.dumps(text)})
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
    for room in (assembling, cache):
        monkeypatch.setattr(room, "versions", lambda _: installed | {"numpy": "99"})
    remarks = finished(RunFolder(run)).result.remarks
    (remark,) = [text for text in remarks if "other versions" in text]
    assert remark.endswith(", now 99")


def test_a_bound_and_all_else_that_differs_are_named(run: Path) -> None:
    config = load(run / "config.toml")
    d = config.parameters["d"].model_copy(update={"lower": 0.5})
    bounded = config.model_copy(update={"parameters": config.parameters | {"d": d}})
    white = {"seed": 5, "model": config.model.model_copy(update={"noise": "white"})}
    for changed, said in (
        (bounded, r"parameters.d.lower was not set when .* is 0\.5; undo"),
        (config.model_copy(update=white), r"seed was 3 .*, is 5 \(also model.noise\); undo"),
    ):
        with pytest.raises(InputError, match=said):
            require_same(fingerprint(config), changed, Path("x"))


def test_what_leaves_the_posterior_may_change(run: Path) -> None:
    config = load(run / "config.toml")
    sampling = {"ess": 9.0, "steps": 7, "pilot_steps": 9, "engine": "auto"}
    d = config.parameters["d"].model_copy(update={"label": "D", "description": "gain"})
    changes = {
        "name": "other",
        "sampling": config.sampling.model_copy(update=sampling),
        "validation": {},
        "truth": {},
        "parameters": config.parameters | {"d": d},
    }
    require_same(fingerprint(config), config.model_copy(update=changes), Path("x"))
    require_same(fingerprint(config), resolve(config, run).config, Path("x"))

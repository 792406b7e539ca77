"""The examples of CONTRIBUTING are run as they stand there."""

import json
import os
import re
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes
from bwbayes.app.config.config import load
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.diagnosis import explanations
from bwbayes.diagnosis.defects import DEFECTS
from bwbayes.diagnosis.residual_analysis import ResidualAnalysis
from bwbayes.inference import map_estimate
from bwbayes.inference.compiled.walk import walk
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.model.inputs import Inputs, Span
from bwbayes.model.inverse import inverse
from bwbayes.model.spec import Extent, ModelSpec
from bwbayes.record.io import formats
from bwbayes.record.teststand import true_values
from tests.app import small
from tests.diagnosis.plants import plant
from tests.prediction.runs import study_of

TEXT = (Path(__file__).resolve().parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")


def example(name: str) -> str:
    found = re.search(rf"<!-- example: {name} -->\n```\w+\n(.*?)```", TEXT, re.DOTALL)
    assert found is not None
    return found[1]


def names_of(name: str) -> dict[str, Any]:
    """Return what an example defines, run as it stands."""
    names: dict[str, Any] = {"__name__": __name__}
    exec(example(name), names)
    return names


def test_the_noise_is_the_gaussian_that_it_says_it_is() -> None:
    """Alone and with another one, against the dense covariance."""
    swinging = names_of("my_noise.py")["Swinging"](0.05)
    time = 0.05 * np.abs(np.subtract.outer(np.arange(60), np.arange(60)))
    covariance = 4 * np.exp(-time / 0.3) * np.cos(2 * np.pi * time / 0.8) + 0.01 * np.eye(60)
    residual = np.random.default_rng(1).standard_normal(60)

    def dense(covariance: np.ndarray) -> float:
        inverse, volume = np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1]
        return float(-0.5 * (residual @ inverse @ residual + volume + 60 * np.log(2 * np.pi)))

    theta = np.array([[0.1, 2.0, 0.3, 0.8]])
    (density,) = swinging.log_density(theta, residual[np.newaxis])
    assert density == pytest.approx(dense(covariance), abs=1e-8)
    both, more = swinging + DiscrepancyNoise(0.05), np.array([[0.1, 2.0, 0.3, 0.8, 0.5, 1.0]])
    (density,) = both.log_density(more, residual[np.newaxis])
    assert density == pytest.approx(dense(covariance + 0.25 * np.exp(-time)), abs=1e-8)


def test_a_stage_of_ones_own_is_in_the_chain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its import path: both engines have it, and a command undoes it."""
    (tmp_path / "my_stage.py").write_text(example("my_stage.py"), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    spec = ModelSpec().with_stages("backlash", "my_stage:SoftMount")
    made = spec.actuator(1e-3, "first", Extent(Span(-50.0, 50.0), 1e-3, 1.0))
    assert made.parameters[-2:] == ("softness", "offset")
    values = true_values(made, {"d": 1.0, "alpha": 0.3, "beta": 0.05, "gamma": 0.02, "offset": 1.0})
    values |= {"exponent": 1.0, "initial": 0.0, "lag": 1e-3, "softness": 300.0}
    theta = np.array([[*values.values()]] * 2)
    voltage = 50 * np.sin(np.arange(400) / 30)
    displacement = made.displacement(theta, voltage, from_rest=True)
    compiled = walk(made, theta, Inputs(voltage, interval=1e-3), from_rest=True)(voltage.size)
    np.testing.assert_allclose(compiled, displacement, rtol=0, atol=1e-10)
    hard = replace(made, stages=made.stages[:1])
    before = hard.displacement(np.delete(theta, -2, axis=1), voltage, from_rest=True) - 1.0
    soft = 1.0 + before / (1 + np.abs(before) / 300.0)
    np.testing.assert_allclose(displacement, soft, rtol=0, atol=1e-10)
    command = inverse(made, theta[:1], displacement[:1], from_rest=True)
    again = made.displacement(theta[:1], command[0], from_rest=True)
    np.testing.assert_allclose(again, displacement[:1], rtol=0, atol=1e-8)


def test_the_stand_tries_a_stage_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fit finds its parameter within four sds, which are small; both engines give one density."""
    for name in ("my_stage.py", "try.toml"):
        (tmp_path / name).write_text(example(name), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    posterior = resolve_config(load(tmp_path / "try.toml"), tmp_path).study.posterior
    rng = np.random.default_rng(1)
    theta = posterior.prior.theta(posterior.prior.draw(rng, 3))
    density = posterior.log_likelihood(theta)
    compiled = replace(posterior, engine="numba")
    assert posterior.engine == "numpy"
    np.testing.assert_allclose(compiled.log_likelihood(theta), density, rtol=1e-9)
    point = map_estimate.fit(compiled, rng)
    near, _ = compiled.prior.constrain(rng.multivariate_normal(point.mode, point.covariance, 1000))
    found = near[:, compiled.names.index("softness")]
    assert abs(np.mean(found) - 500.0) < 4 * np.std(found)
    assert np.std(found) < 50.0


def test_an_operator_of_ones_own_is_simulated_fast_and_inverted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its import path: along its first branch and the next, on both engines and back."""
    (tmp_path / "my_operator.py").write_text(example("my_operator.py"), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    spec = ModelSpec.from_keys({"hysteresis": "my_operator:TanhLoop", "dynamics": "none"})
    made = spec.actuator(1e-3, "first", Extent(Span(-50.0, 50.0), 1e-3, 1.0))
    assert made.parameters == ("d", "alpha", "width", "initial", "offset")
    theta = np.array([[1.2, 9.0, 20.0, 0.0, 1.0], [0.8, 5.0, 35.0, 0.0, 0.0]])
    voltage = np.concatenate([np.linspace(0, 50, 200), np.linspace(50, -20, 300)[1:]])

    def branch(distance: FloatArray) -> FloatArray:
        d, alpha, width = theta.T[:3, :, np.newaxis]
        return np.asarray(d * distance - alpha * np.tanh(distance / width))

    rising, falling = branch(voltage[:200]), branch((50 - voltage[200:]) / 2)
    expected = np.concatenate([rising, rising[:, -1:] - 2 * falling], axis=1) + theta[:, 4:]
    displacement = made.displacement(theta, voltage, from_rest=True)
    np.testing.assert_allclose(displacement, expected, rtol=0, atol=1e-10)
    compiled = walk(made, theta, Inputs(voltage, interval=1e-3), from_rest=True)(voltage.size)
    np.testing.assert_allclose(compiled, expected, rtol=0, atol=1e-10)
    command = inverse(made, theta[:1], displacement[:1], from_rest=True)
    np.testing.assert_allclose(command[0], voltage, rtol=0, atol=1e-6)


def test_a_format_of_ones_own_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the way of any file: by its content, with its units, and in one line where it is cut."""
    (tmp_path / "my_reader.py").write_text(example("my_reader.py"), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    added = formats.Format(b"SCOPE1", ".scp", "my_reader:read_scope")
    monkeypatch.setattr(formats, "FORMATS", (*formats.FORMATS, added))
    voltage = np.float32(40 * np.sin(np.arange(300) / 20))
    content = b"SCOPE1" + struct.pack("<d", 2e-3) + np.stack([voltage, 600 * voltage], 1).tobytes()
    file = tmp_path / "record.bin"
    file.write_bytes(content)
    record = bwbayes.read_record(file)
    assert (record.samples, record.interval) == (300, 2e-3)
    np.testing.assert_array_equal(record.voltage, voltage)
    assert record.displacement is not None
    np.testing.assert_allclose(record.displacement, 0.6 * record.voltage, rtol=1e-6)
    file.write_bytes(content[:-3])
    with pytest.raises(bwbayes.InputError, match=r"record.bin: damaged or cut off .*; write it"):
        bwbayes.read_record(file)


@pytest.mark.parametrize("size", [0.0, 0.5])
def test_a_defect_of_ones_own_is_named_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: float
) -> None:
    """Before a vibration of any frequency, which has more to pay for; not in a good record."""
    swaying_of = names_of("my_defect.py")["Swaying"]
    added = swaying_of("swaying table", "oscillation", noise=True)
    tried = (DEFECTS["oscillation"], DEFECTS["drift"], added)
    monkeypatch.setattr(explanations, "ADDITIONS", [defect.explanations for defect in tried])
    monkeypatch.setattr(explanations, "CHANGES", ())
    record = plant("good", (5, 1), 4.0)
    assert record.displacement is not None
    swaying = record.displacement + size * np.sin(2 * np.pi * 2.7 * record.time)
    bwbayes.write_record(replace(record, displacement=swaying), tmp_path / "record.h5")
    text = '[record]\nfile = "record.h5"\nfrom_rest = true\n[model]\nnoise = "discrepancy"\n'
    study = study_of(text, tmp_path)
    rng = np.random.default_rng(1)
    optima = map_estimate.fit(study.posterior, rng).optima
    ranked = explanations.explain(ResidualAnalysis.of(study.posterior, optima, rng, study))
    causes = explanations.likely_causes(ranked)
    if size:
        assert (causes[0].kind, ranked[0].kind) == ("swaying table", "swaying table")
        (um,) = re.findall(r"table that sways by ([\d.]+) um", causes[0].text)
        assert float(um) == pytest.approx(size, rel=0.2)
    else:
        assert not causes


def test_a_sampler_of_ones_own_goes_on_where_a_run_ended(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results/my").symlink_to(small.finished(tmp_path_factory))
    monkeypatch.chdir(tmp_path)
    names = names_of("sampler")
    sampler, end = names["sampler"], names["end"]
    fit = bwbayes.open_run("results/my")
    np.testing.assert_array_equal(end.coords, fit.chain.ends[0].coordinates)
    assert (20, *end.coords.shape) == sampler.get_chain().shape
    assert 0.1 < np.mean(sampler.acceptance_fraction)


# A second product, which falls short; its type hints are quoted, and it shows no progress.
SHORT = '''
from bwbayes.errors import ExitStatus

class Far(Reach):
    NAME = "very-far"
    shortfall = "it does not move far enough"
    exit_status = ExitStatus.VALIDATION_INCONCLUSIVE

def very_far(fit: "Run", least: "float") -> "Far":
    """Say whether it moves far."""
    return Far(least, fit.standing)
'''

# Runs each command line in one process, and a method beside.
DRIVER = """
import contextlib, io, json, pydoc, sys, warnings
from bwbayes.app import verbs
verbs.VERBS += (verbs.Verb("my_product:reach"), verbs.Verb("my_product:very_far"))
import bwbayes
from bwbayes.app.commands import cli
from bwbayes.app.running.progress import StepProgress
said, steps = [], []
StepProgress.__call__ = lambda _, *step: steps.append(step)
for line in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    sys.argv = ["bwbayes", *line.split()]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as end:
            said.append((end.code, out.getvalue(), err.getvalue(), steps))
            steps = []
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    um = bwbayes.open_run("failed").reach(after=1.0).um
text = pydoc.plain(pydoc.render_doc(bwbayes.Run.reach))
method = um, [str(warning.message) for warning in caught], text
print(json.dumps((said, method)))
"""


@pytest.fixture(scope="module")
def product(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[int, Any], tuple[Any, ...]]:
    """Return status and outputs of command lines with the example's product, and of its method."""
    folder = tmp_path_factory.mktemp("product")
    (folder / "my_product.py").write_text(example("my_product.py") + SHORT)
    shutil.copytree(small.finished(tmp_path_factory), folder / "my")
    shutil.copytree(folder / "my", folder / "failed")
    numbers = json.loads((folder / "failed/summary.json").read_text())
    numbers["validation"]["held-out"] |= {"passed": False, "message": "held-out: it does not hold"}
    (folder / "failed/summary.json").write_text(json.dumps(numbers))
    lines = [
        "--help",
        "reach --help",
        "reach my --after 1 --out out",
        "reach my --after 1 --out out",
        "reach my --after 999",
        "reach my --after x",
        "reach none",
        "reach failed --quiet",
        "very-far my 3",
        "very-far my",
    ]
    environment = {**os.environ, "COLUMNS": "100"}
    command = [sys.executable, "-c", DRIVER, json.dumps(lines)]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    said, method = json.loads(done.stdout)
    assert (folder / "out/reach.html").exists()
    assert (folder / "failed/reach/reach.json").exists()
    return dict(enumerate(said)), method


def test_a_product_gets_its_command(product: tuple[dict[int, Any], tuple[Any, ...]]) -> None:
    """Its help and progress, its files and exit statuses, and errors of one line."""
    said, _ = product
    assert re.search(r"\n  reach +Say how far the actuator moves along its records\.\n", said[0][1])
    help_text = " ".join(said[1][1].split())
    assert "reach [OPTIONS] FOLDER Say how far" in help_text
    assert "Example: bwbayes reach results/my --after 2" in help_text
    assert "--after FLOAT Time from which on it counts, s. [default: 0.0]" in help_text
    status, out, err, steps = said[2]
    assert (0, "") == (status, err)
    shares = [share for name, share in steps if name == "records"]
    assert [0.0, 1.0] == [shares[0], shares[-1]]
    assert shares == sorted(shares)
    assert re.search(r"It moves by [\d.]+ um\.\n", out)
    assert "wrote out/reach.json\n" in out
    refused = {
        3: "out/reach.json: exists; choose another name, or give `--overwrite`",
        4: "after: 999 s is behind every record; give less",
        5: "Invalid value for '--after': 'x' is not a valid float.",
        6: "none: no run here; start one with `bwbayes run RECORD --out none`",
        9: "Missing argument 'LEAST'.",
    }
    for number, line in refused.items():
        assert [2, "", f"bwbayes: {line}\n"] == said[number][:3]
    assert [3, "", "VALIDATION FAILED: held-out: it does not hold\n"] == said[7][:3]
    status, out, err, _ = said[8]
    assert (5, "it does not move far enough\n") == (status, err)
    assert "It moves by 3 um." in out


def test_a_product_gets_its_method(product: tuple[dict[int, Any], tuple[Any, ...]]) -> None:
    """With its help; it warns of what the run's bands do not hold, as the command says it."""
    said, (um, warned, text) = product
    assert f"It moves by {um:.3g} um." in said[2][1]
    assert ["VALIDATION FAILED: held-out: it does not hold"] == warned
    assert re.search(r"\(fit: [\w.]*Run, \*, after: float = 0\.0", text)
    assert "Time from which on it counts, s." in text

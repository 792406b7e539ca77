"""What ``import bwbayes`` offers: these names, documented, typed, and nothing loaded for them."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import bwbayes

# A name that leaves this list breaks somebody's program.
PUBLIC = {
    "bwbayes.app.config.config": {"Config", "load as load_config", "parse as parse_config"},
    "bwbayes.app.fit.calls": {"compare", "fit", "open_run", "resume_run"},
    "bwbayes.app.fit.campaigns": {"Campaign", "campaign"},
    "bwbayes.app.fit.fitted": {"Fit"},
    "bwbayes.app.running.predictions": {"Prediction"},
    "bwbayes.app.problem.problem": {"Problem", "resolve"},
    "bwbayes.data.io.formats": {"read_record", "write_record"},
    "bwbayes.data.inspection": {"Finding", "inspect"},
    "bwbayes.data.record": {"Record"},
    "bwbayes.data.teststand": {"VirtualTestStand"},
    "bwbayes.data.waveforms": {"Waveform", "signal"},
    "bwbayes.errors": {"InputError", "InputWarning", "NotConvergedError"},
    "bwbayes.sampling.chain": {"Chain"},
    "bwbayes.model.distributions": {"Distribution"},
    "bwbayes.inference.noise": {"noise_model"},
    "bwbayes.inference.parameters": {"JointPrior", "Parameter"},
    "bwbayes.inference.pointfit": {"PointFit", "fit as point_fit"},
    "bwbayes.inference.posterior": {"Posterior"},
    "bwbayes.sampling.sampler": {"Outcome", "SamplingPlan", "draws", "first_chain", "sample"},
    "bwbayes.model.actuator": {"Actuator"},
    "bwbayes.model.boucwen": {"hysteresis"},
    "bwbayes.population.population": {"Population"},
    "bwbayes.results.bands": {"Bands"},
    "bwbayes.results.calibration": {"Calibration", "judge"},
    "bwbayes.results.replicates": {"Experiment", "Replicate", "replicates"},
    "bwbayes.results.loops": {"Loops", "measure_loops"},
    "bwbayes.results.prediction": {"forecast", "predict_record", "predict_windows", "thinned"},
    "bwbayes.results.scores": {"Scores", "score"},
    "bwbayes.results.start": {"Start"},
    "bwbayes.results.steps": {"Step", "StepResponse", "measure_step"},
    "bwbayes.results.verdict": {"Background", "Verdict", "assess"},
}
HOMES = {
    text.split(" as ")[-1]: (module, text.split(" as ")[0])
    for module, texts in PUBLIC.items()
    for text in sorted(texts)
}
every_name = pytest.mark.parametrize("name", sorted(HOMES))


def test_the_public_names_are_these() -> None:
    assert sorted(HOMES) == sorted(bwbayes.__all__)
    assert set(HOMES) <= set(dir(bwbayes))


@every_name
def test_a_public_name_is_what_its_module_defines(name: str) -> None:
    module, original = HOMES[name]
    result = getattr(bwbayes, name)
    assert (module, original) == (result.__module__, result.__name__)


@every_name
def test_a_public_name_is_documented(name: str) -> None:
    result = getattr(bwbayes, name)
    # A dataclass without a docstring of its own gets its signature for one.
    assert not (inspect.getdoc(result) or f"{name}(").startswith(f"{name}(")


def test_type_checkers_find_each_name_where_it_is_loaded_from() -> None:
    source = Path(bwbayes.__file__).read_text(encoding="utf-8")
    (checking,) = (node for node in ast.parse(source).body if isinstance(node, ast.If))
    imported = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in checking.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert imported == HOMES


def test_a_name_that_does_not_exist_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'hysterese'"):
        _ = bwbayes.hysterese  # type: ignore[attr-defined]  # this must be an error there too


def test_importing_the_package_loads_no_library() -> None:
    code = "import sys, bwbayes; print(*{name.split('.')[0] for name in sys.modules})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split()) - {"bwbayes"}
    assert not loaded & {"numpy", "scipy", "emcee", "h5py", "matplotlib", "pydantic"}


def test_asking_for_help_loads_no_library() -> None:
    """Nothing but what reads a command line: help is there at once."""
    code = (
        "import sys; from bwbayes.app.commands.cli import cli; "
        "cli(['--help'], standalone_mode=False); cli(['run', '--help'], standalone_mode=False); "
        "print(*{name.split('.')[0] for name in sys.modules})"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.splitlines()[-1].split())
    assert not loaded & {
        "arviz", "emcee", "h5py", "matplotlib", "numba", "numpy", "pandas", "pydantic", "scipy",
        "xarray",
    }  # fmt: skip


def test_the_docstrings_example_runs() -> None:
    assert bwbayes.__doc__ is not None
    example = bwbayes.__doc__.split("::\n\n")[1].split("\n\nThe names")[0]
    names: dict[str, object] = {}
    exec(inspect.cleandoc(example), names)
    assert (2, 2000) == getattr(names["h"], "shape", None)

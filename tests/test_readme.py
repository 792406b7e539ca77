"""The README's commands are there, and the numbers it quotes are those of its first command."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from bwbayes.app import cli

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def block(name: str) -> str:
    """Return what stands between ``<!-- name -->`` and the next ``<!-- -->``."""
    found = re.search(rf"<!-- {name} -->\n(.*?)<!-- -->", README, flags=re.DOTALL)
    assert found, f"the README has no block {name}"
    return found.group(1)


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Run the README's first command, but for the installation."""
    folder = tmp_path_factory.mktemp("readme") / "ring_bender"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["bwbayes", "run", "runs/ring_bender.toml", "--out", str(folder)])
        patch.chdir(ROOT)
        with pytest.raises(SystemExit) as ended:
            cli.main()
    assert ended.value.code == 0
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def test_each_command_starts_from_a_bare_checkout() -> None:
    for name in ("run", "tests"):
        lines = block(name).strip().splitlines()
        assert len(lines) == 3
        assert lines[1].startswith("python3 -m venv .venv && .venv/bin/pip install ")


def test_ci_runs_the_test_command_of_the_readme() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "<!-- tests -->" in script


def test_the_files_and_figures_that_the_readme_names_exist() -> None:
    for path in re.findall(r"\]\((\S+?)\)", README):
        assert (ROOT / path).is_file(), path


def test_the_first_command_converges_with_the_effective_draws_it_was_asked_for(
    summary: Any,
) -> None:
    assert summary["converged"] is True
    for name, row in summary["parameters"].items():
        assert min(row["ess_bulk"], row["ess_tail"]) >= 4000, name
        assert row["rhat"] < 1.01, name


def test_the_quoted_parameters_are_those_of_the_run(summary: Any) -> None:
    """Within a tenth of an sd: what is quoted is rounded, and other machines round differently."""
    rows = [
        line.split("|")[1:-1] for line in block("numbers: ring_bender").strip().splitlines()[2:]
    ]
    quoted = {row[0].strip(): [float(cell) for cell in row[2:]] for row in rows}
    assert set(summary["parameters"]) == set(quoted)
    for name, (truth, mean, sd) in quoted.items():
        run = summary["parameters"][name]
        assert truth == pytest.approx(run["truth"])
        assert abs(mean - run["mean"]) < 0.1 * run["sd"], name
        assert sd == pytest.approx(run["sd"], rel=0.1), name


def test_the_quoted_verification_is_that_of_the_run(summary: Any) -> None:
    text = block("numbers: verification")
    quoted = [float(number) for number in re.findall(r"\*\*([\d.]+)", text)]
    run = summary["validation"]["verification"]
    expected = [
        run["coverage"]["sensor"]["95"] * 100,
        run["coverage_error"]["sensor"]["95"] * 100,
        run["width_95_um"],
        run["nrmse"] * 100,
        run["max_error_um"],
    ]
    for wanted, got in zip(quoted, expected, strict=True):
        assert wanted == pytest.approx(got, rel=0.05, abs=0.3)

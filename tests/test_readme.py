"""The README's commands are there, and the numbers it quotes are those of its commands.

Those of its first command are held against a run of it; those of the slow ones against what was
measured when they last ran in full.
"""

import json
import re
from pathlib import Path
from runpy import run_path
from typing import Any

import numpy as np
import pytest

from bwbayes import read_record
from bwbayes.app.commands import cli
from bwbayes.app.config.config import SamplingConfig
from bwbayes.inference.noise import DiscrepancyNoise
from bwbayes.model.declaration import Context, Distribution, Ranges
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.prediction import prediction
from bwbayes.record.teststand import VirtualTestStand
from bwbayes.record.waveforms import Waveform, sine
from bwbayes.sampling import diagnostics
from tests.app import small
from tests.examples import README, ROOT, blocks
from tests.measured import assert_quotes, keep, measured, quotes
from tests.test_measured_stack import RECORD
from tests.test_promises import OTHERS
from tests.test_what_drives_tell import DRIVES, LENGTHS


def block(name: str) -> str:
    """Return what stands between ``<!-- name -->`` and the next ``<!-- -->``."""
    result = re.search(rf"<!-- {name} -->\n(.*?)<!-- -->", README, flags=re.DOTALL)
    assert result, f"the README has no block {name}"
    return result.group(1)


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Run the README's first command, but for the installation, pictures and explanations."""
    folder = tmp_path_factory.mktemp("readme") / "ring_bender"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["bwbayes", "run", "runs/ring_bender.toml", "--out", str(folder)])
        patch.chdir(ROOT)
        small.without_pictures(patch)
        small.without_explanations(patch)
        with pytest.raises(SystemExit) as ended:
            cli.main()
    assert ended.value.code == 0
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def test_the_lines_of_python_go_from_arrays_to_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    small.without_explanations(monkeypatch)
    stand = VirtualTestStand(discrepancy="none", sample_rate=500.0)
    generator = np.random.default_rng(1)
    record = stand.run(Waveform(sine(100.0, 1.0), 7.0, decay=0.1), generator)
    names: dict[str, Any] = {
        "voltage": record.voltage,
        "displacement": record.displacement,
        "new_record": stand.run(Waveform(sine(80.0, 0.7), 4.0), generator),
    }
    (lines,) = blocks("python")
    # That is what a reader does, with a quarter of the samples, fewer draws and walkers.
    lines = lines.replace("interval=1e-3", "interval=2e-3")
    exec(lines.replace("12))", "6), ess=400, walkers=24)"), names)
    assert names["fit"].converged
    assert names["bands"].scores.nrmse < 0.05
    columns = ["time_s", "voltage_V", "displacement_um", "mean_um"]
    assert columns == [*names["bands"].to_pandas()][:4]
    assert names["bands"].plot().axes


def test_each_command_starts_from_a_bare_checkout() -> None:
    for name in ("run", "tests"):
        lines = block(name).strip().splitlines()
        assert len(lines) == 3
        assert lines[1].startswith("python3 -m venv .venv && .venv/bin/pip install ")


def test_ci_runs_the_test_command_of_the_readme() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "<!-- tests -->" in script


def test_the_files_and_figures_that_the_readme_names_exist() -> None:
    for link in re.findall(r"\]\((\S+?)\)", README):
        path, _, heading = link.partition("#")
        assert (ROOT / path).is_file(), path
        if heading:
            lines = (ROOT / path).read_text(encoding="utf-8").splitlines()
            assert f"## {heading.capitalize()}" in lines, link


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
    quoted = {row[0].strip(): [float(cell) for cell in row[3:]] for row in rows}
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
    for required, got in zip(quoted, expected, strict=True):
        assert required == pytest.approx(got, rel=0.05, abs=0.3)


def test_the_quoted_campaign_is_that_of_the_last_benchmark() -> None:
    one = measured()["benchmark of a campaign"]
    assert one["refused"] == one["not converged"] == 0
    text = (
        f"{one['records']:,} records of 300 samples took {one['core s a record']:.1f} core seconds "
        f"and {one['KiB a record'] / 1024:.0f} MB each, and {one['s to combine them'] / 60:.0f} "
        "minute to put together"
    )
    assert text in " ".join(README.split())


def test_the_quoted_evaluations_of_an_effective_draw_are_those_of_the_run(summary: Any) -> None:
    """As many draws as stated, within a fifth: effective draws are estimates."""
    quoted = re.search(r"One costs \*\*([\d.]+)\*\* simulations", " ".join(README.split()))
    assert quoted
    least = min(min(row["ess_bulk"], row["ess_tail"]) for row in summary["parameters"].values())
    evaluations = sum(summary["sampling"]["proposals"].values())
    assert float(quoted.group(1)) == pytest.approx(evaluations / least, rel=0.2)


def test_the_quoted_limits_are_those_of_the_last_full_run() -> None:
    text = " ".join(re.findall(r"\*\*([\d.,]+)\*\*", block("numbers: limits")))
    assert_quotes(
        text,
        "extent 100 moving, */coverage and t/*/95/0",
        "extent 100 one answer at any rate/coverage/*/95",
        "extent 100 untried/coverage/*",
        "extent 100 a * discrepancy of 1.3 s/coverage/95",
        "ordinary answers/other/False",
        "ordinary answers/seeds",
        "ordinary answers/other/True",
        *(
            f"cost of a fit/{model}/{length}/core s"
            for model, lengths in LENGTHS.items()
            for length in lengths
        ),
    )


def test_what_drives_tell_is_what_the_last_full_run_found() -> None:
    rows = [line.split("|")[2:-1] for line in block("numbers: drives").strip().splitlines()[2:]]
    for row, drive in zip(rows, DRIVES, strict=True):
        for cell, name in zip(row, ("d", "alpha", "beta", "gamma", "lag"), strict=True):
            found = measured()["what drives tell"][drive]
            for text, readings in zip(cell.split("/"), ("100", "10000"), strict=True):
                assert quotes(text.strip(), found[readings][name]), (drive, name)


def test_what_other_methods_say_is_what_the_last_full_run_found() -> None:
    names = ("error_um", "error_percent", "width_um", "covered_percent")
    rows = [line.split("|")[1:-1] for line in block("numbers: beside others").strip().splitlines()]
    for (method, *cells), found in zip(rows[2:], OTHERS, strict=True):
        row = measured()["beside others"][found]
        seconds = re.search(r"\(([\d.]+)\) $", method)
        assert seconds, method
        assert quotes(seconds[1], row["core s"]), found
        for cell, name in zip(cells, names, strict=True):
            for text, test in zip(cell.split("/"), ("large loops", "decay and hold"), strict=True):
                assert quotes(text.strip(), row[test][name]), (found, test, name)


METHODS = (ROOT / "runs" / "README.md").read_text(encoding="utf-8")


def test_the_methods_state_the_priors_of_the_code() -> None:
    """For a record whose half ranges and time between reversals are one."""
    one = Context(Ranges(1.0, 1.0, 0.0, 1.0), {})
    declared = [*BoucWen().parameters, *DiscrepancyNoise(1.0).declarations]
    default = {each.name: each.default(one) for each in declared}
    symbols = {"d": "d", "alpha": "α", "beta": "β", "sensor_sd": "sensor noise s"}
    symbols |= {
        "discrepancy_sd": "model discrepancy σ",
        "discrepancy_time": "its correlation time τ",
    }
    for name, symbol in symbols.items():
        prior = default[name]
        assert isinstance(prior, Distribution)
        (row,) = (line for line in METHODS.splitlines() if line.startswith(f"| {symbol} | "))
        median, sigma = (float(prior.arguments[key]) for key in ("median", "sigma"))
        assert re.search(rf"median {median:g}[ /]", row.replace("1e-5", "1e-05")), row
        assert f"sigma {sigma:g}" in row
    gamma = default["gamma"]
    assert isinstance(gamma, Distribution)
    assert gamma.arguments == {"mean": 0.0, "sd": 4.0}


def test_the_methods_state_when_a_sampling_has_converged() -> None:
    for requirement in (
        f"| < {diagnostics.MAX_RHAT:g} |",
        f"| < {diagnostics.MAX_WALKER_RHAT:g} |",
        f"| {diagnostics.LENGTH} autocorrelation times |",
        f"| < {diagnostics.MAX_PARETO_K:g} |",
        f"| {SamplingConfig().ess:,.0f} by default |",
        f"Each of {prediction.DRAWS:,} draws",
    ):
        assert requirement in METHODS, requirement


# Four methods on one measured record: what ``runs/beside_others.py`` finds, and README quotes


RUNS = Path(__file__).parents[1] / "runs"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::bwbayes.InputWarning")
def test_the_default_errs_less_on_large_loops_than_three_usual_methods() -> None:
    """On large loops as were fitted. On a decay and a hold least squares may be better."""
    compared = run_path(str(RUNS / "beside_others.py"))["compare"](read_record(RECORD))
    table = compared.table
    keep("beside others", table)
    ours = table.pop("bwbayes")
    for test, factor in {"large loops": 1.0, "decay and hold": 1.5}.items():
        least = min(row[test]["error_um"] for row in table.values())
        assert ours[test]["error_um"] < factor * least, test

"""Campaigns at their real size: two hundred actuators of a known population, and twenty kills.

SPECIMENS and KILLS say how many, if not so many.
"""

import json
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bwbayes as bw
from bwbayes.app.config.config import parse
from bwbayes.app.jobs.campaign import config_text, resume, start
from bwbayes.app.study.resolve import resolve_config
from tests.app import small
from tests.app.specimens import CONFIG, specimens
from tests.measured import keep

SPECIMENS = int(os.environ.get("SPECIMENS", "200"))
KILLS = int(os.environ.get("KILLS", "20"))

# Medians and relative spreads of the population.
POPULATION = {"d": (0.7, 0.04), "alpha": (0.3575, 0.06), "beta": (0.0272, 0.08), "lag": (0.01, 0.1)}

STAND = """\
seed = {seed}

[record]
signal = {{ amplitude = 100.0, frequency = 1.0, duration = 8.0, decay = 0.1, decay_from = 1.0 }}

[model]
dynamics = "lag"

[stand]
sample_rate = 250.0
discrepancy = "none"

[stand.model]
dynamics = "lag"

[stand.parameters]
"""

STUDY = """\
seed = 3

[record]
train = [[0.0, 6.5]]

[model]
dynamics = "lag"
noise = "white"

[parameters]
initial = { fixed = 0.0 }

[sampling]
ess = 800

[validation.end]
window = [6.5, 8.0]
"""

HEAD = "time_s,voltage_V,displacement_um\n"

# Ten ways in which a record can be of no use.
MALFORMED = {
    "empty": "",
    "head_only": HEAD,
    "words": HEAD + "0,0,x\n0.1,1,1\n",
    "two_columns": "time_s,voltage_V\n0,0\n0.1,1\n0.2,3\n",
    "backwards": HEAD + "0,0,0\n0.1,1,1\n0.05,2,2\n",
    "uneven": HEAD + "0,0,0\n0.1,1,1\n0.9,2,2\n1.0,1,2\n",
    "no_unit": "time,voltage,displacement\n0,0,0\n0.1,1,1\n",
    "ragged": HEAD + "0,0,0\n0.1,1\n",
    "flat": HEAD + "".join(f"{0.004 * i:.3f},50,1\n" for i in range(2000)),
    "binary": "\0\1\2" * 100,
}


def truths() -> dict[str, dict[str, float]]:
    generator = np.random.default_rng(11)
    return {
        f"s{number:03d}": {
            name: float(median * np.exp(spread * generator.standard_normal()))
            for name, (median, spread) in POPULATION.items()
        }
        for number in range(SPECIMENS)
    }


def written(folder: Path) -> None:
    folder.mkdir()
    for number, (name, values) in enumerate(truths().items()):
        lines = "".join(f"{key} = {value!r}\n" for key, value in values.items())
        text = STAND.format(seed=number + 1) + lines
        bw.write_record(
            resolve_config(parse(text, name), Path()).study.record, folder / f"{name}.csv"
        )
    for name, content in MALFORMED.items():
        (folder / f"bad_{name}.csv").write_text(content)


def assert_covers(inside: Sequence[float], level: float, what: str) -> float:
    """Within three standard errors of the level, from the spread between specimens or binomial."""
    mean = float(np.mean(inside))
    error = max(np.std(inside), np.sqrt(level * (1 - level))) / np.sqrt(len(inside))
    assert abs(mean - level) <= 3 * error, f"{what}: {mean:.3f} for {level}"
    return mean


@pytest.mark.slow
def test_a_campaign_covers_and_reports_what_is_malformed(tmp_path: Path) -> None:
    written(tmp_path / "records")
    (tmp_path / "study.toml").write_text(STUDY)
    config = config_text(tmp_path / "study.toml")
    folder = start(tmp_path / "records", config, tmp_path, tmp_path / "out", pictures=False)
    ended = resume(folder, small.quiet())
    assert 2 == ended.exit_status
    refused = {row.name: row.reason for row in ended.rows if row.status == "refused"}
    assert {f"bad_{name}" for name in MALFORMED} == set(refused)
    assert all("\n" not in reason and reason for reason in refused.values())
    fitted = {row.name: row for row in ended.rows if row.parameters}
    assert SPECIMENS == len(fitted)
    result: dict[str, Any] = {"specimens": SPECIMENS}
    known = truths()
    for name, (median, spread) in POPULATION.items():
        own, shrunk, ratio = [], [], []
        for record, values in known.items():
            one = fitted[record].parameters[name]
            among = ended.population.parameters[name].specimens[record]
            own.append(one["lower_95"] < values[name] < one["upper_95"])
            shrunk.append(among.lower < values[name] < among.upper)
            ratio.append((among.upper - among.lower) / (one["upper_95"] - one["lower_95"]))
        result[name] = {
            "own": assert_covers(own, 0.95, f"{name} alone"),
            "shrunk": assert_covers(shrunk, 0.95, f"{name} shrunk"),
            "width": float(np.mean(ratio)),
        }
        # Draws of a finite number: a specimen that is all sure stays as wide.
        assert result[name]["width"] < 1.02
        told = ended.population.parameters[name]
        for draws, truth in ((told.mean, median), (told.spread, spread)):
            # 99.9%, for there is one population.
            assert np.quantile(draws, 0.0005) < truth < np.quantile(draws, 0.9995), name
    for level in ("50", "90", "95"):
        inside = [
            r.numbers["validation"]["end"]["coverage"]["sensor"][level] for r in fitted.values()
        ]
        result[f"sensor {level}"] = assert_covers(inside, int(level) / 100, f"sensor {level}")
    keep("campaign", result)


@pytest.mark.slow
def test_kills_at_any_moment_change_no_byte(tmp_path: Path) -> None:
    """SIGKILL after a random part of what is left, again and again, and the same tables."""
    specimens(tmp_path / "records", 6)
    (tmp_path / "records/broken.csv").write_text(MALFORMED["words"])
    (tmp_path / "small.toml").write_text(CONFIG)
    common = ["campaign", "records", "--config", "small.toml", "--no-pictures", "--quiet"]

    def command(out: str) -> list[str]:
        return small.command(*common, "--workers", "1", "--out", out)

    begun = time.monotonic()
    assert 2 == subprocess.run(command("whole"), cwd=tmp_path, check=False).returncode
    seconds = time.monotonic() - begun
    generator = np.random.default_rng(3)
    killed = 0
    while killed < KILLS:
        running = subprocess.Popen(command("killed"), cwd=tmp_path, start_new_session=True)
        try:
            running.wait(generator.uniform(0.3, 0.7) * seconds)
        except subprocess.TimeoutExpired:
            os.killpg(running.pid, signal.SIGKILL)
            killed += 1
        if running.wait() == 2 and killed < KILLS:
            # It came to its end before the last kill: make half of it again.
            for name in ("s001", "s003", "s005"):
                (tmp_path / f"killed/records/{name}/summary.json").unlink()
    assert 2 == subprocess.run(command("killed"), cwd=tmp_path, check=False).returncode
    for name in ("campaign.csv", "campaign.json", "figures/parameters.png"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "killed" / name).read_bytes()
    records = json.loads((tmp_path / "killed/campaign.json").read_text())["records"]
    assert 7 == len(records)
    keep("campaign kills", {"kills": killed})

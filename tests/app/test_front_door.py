"""The first minute: whatever ordinary record a user has, it gets a config that resolves, and a run.

Records are made by a play model of the tests' own, at any length, rate, start time, unit and
separator; what is checked is all that a run does before it samples.
"""

import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings, strategies as st
from scipy import stats

from bwbayes.app.commands.cli import cli
from bwbayes.app.config.proposal import draft_config
from bwbayes.app.fit.fitted import Run
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.running.run import resume
from bwbayes.app.study.resolve import resolve_config
from bwbayes.arrays import FloatArray
from bwbayes.errors import InputError, InputWarning
from bwbayes.record.io.columns import Naming
from bwbayes.record.io.grid import decimals_of
from tests.app import small
from tests.measured import keep
from tests.record.instruments import Written
from tests.record.makers import INSTRUMENTS
from tests.stand import play

UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
    "voltage": {"V": 1.0, "mV": 1e-3, "kV": 1e3, "µV": 1e-6},
    "displacement": {"um": 1.0, "µm": 1.0, "nm": 1e-3, "mm": 1e3, "m": 1e6, "pm": 1e-6},
}
SEPARATORS = [",", ";", "\t", "|", " ", ", ", "  "]


def drive(kind: str, periods: float, time: FloatArray) -> FloatArray:
    """Return a voltage over the times 0 to 1 of a record, V."""
    phase = 2 * np.pi * periods * time
    size: FloatArray = {
        "sine": np.ones_like(time),
        "decaying": np.exp(-1.8 * time),
        "growing": 0.1 + 0.9 * time,
        "unipolar": np.ones_like(time),
        "chirp": np.ones_like(time),
        "triangle": np.exp(-time),
    }[kind]
    if kind == "chirp":
        phase = phase * (0.3 + 0.7 * time)
    wave = 2 / np.pi * np.arcsin(np.sin(phase)) if kind == "triangle" else np.sin(phase)
    voltage: FloatArray = 80.0 * size * wave
    return voltage / 2 + 45.0 if kind == "unipolar" else voltage


def moved(voltage: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the displacement of two plays and a gain, with noise, um."""
    away = voltage - voltage[0]
    result = 0.4 * voltage + 0.2 * play(away, 8.0) + 0.15 * play(away, 25.0)
    return result + 0.05 * rng.standard_normal(voltage.size)


def written(
    path: Path,
    voltage: FloatArray,
    displacement: FloatArray,
    *,
    rate: float = 1000.0,
    start: float = 0.0,
    units: tuple[str, str, str] = ("s", "V", "um"),
    separator: str = ",",
    header: bool = True,
) -> Path:
    scales = [UNITS[q][unit] for q, unit in zip(UNITS, units, strict=True)]
    decimals = max(decimals_of(1 / rate) + 3 + round(np.log10(scales[0])), 0)
    times = [f"{(start + i / rate) / scales[0]:.{decimals}f}" for i in range(voltage.size)]
    columns = [times] + [
        [f"{value:.9g}" for value in values / scale]
        for values, scale in zip((voltage, displacement), scales[1:], strict=True)
    ]
    names = [f"{name}_{unit}" for name, unit in zip(UNITS, units, strict=True)]
    lines = [separator.join(names)] * header
    path.write_text("\n".join([*lines, *map(separator.join, zip(*columns, strict=True))]) + "\n")
    return path


def resolved(path: Path, naming: Naming | None = None) -> Run:
    """Return the problem of a file that has no config: all but the sampling of a run."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return resolve_config(draft_config(path, path.parent, naming).config, path.parent)


@settings(suppress_health_check=list(HealthCheck))
@given(
    samples=st.integers(200, 3000),
    rate=st.one_of(
        st.sampled_from([1.0, 200.0, 500.0, 1000.0, 1e5]),
        st.floats(0, 5).map(lambda power: float(f"{10**power:.6g}")),
    ),
    start=st.sampled_from([0.0, -3.2, 0.005, 25.0, 1234.567, 86_400.0, 1.7e9, 1_732_336_257.123]),
    units=st.tuples(*(st.sampled_from(list(table)) for table in UNITS.values())),
    separator=st.sampled_from(SEPARATORS),
    kind=st.sampled_from(["sine", "decaying", "growing", "unipolar", "chirp", "triangle"]),
    periods=st.floats(1.5, 12),
    seed=st.integers(0, 2**32 - 1),
)
@example(
    samples=200,
    rate=1.0,
    start=0.0,
    units=("s", "V", "um"),
    separator=",",
    kind="decaying",
    periods=5.0,
    seed=200,
)  # no jump at its third sample
@example(
    samples=300,
    rate=56_234.1,
    start=1.7e9,
    units=("s", "V", "um"),
    separator=",",
    kind="sine",
    periods=5.0,
    seed=1,
)  # 1.778e-5 s is not the interval
def test_any_ordinary_record_gets_a_config_that_resolves(
    tmp_path: Path,
    samples: int,
    rate: float,
    start: float,
    units: tuple[str, str, str],
    separator: str,
    kind: str,
    periods: float,
    seed: int,
) -> None:
    """Every window holds readings, and what is held out is a quarter, or nothing."""
    voltage = drive(kind, periods, np.arange(samples) / samples)
    displacement = moved(voltage, np.random.default_rng(seed))
    options: dict[str, Any] = {"rate": rate, "start": start, "units": units}
    path = written(tmp_path / "a.csv", voltage, displacement, separator=separator, **options)
    problem = resolved(path)
    record = problem.study.record
    assert (samples, samples) == (record.samples, record.readings)
    scale = UNITS["time"][units[0]]
    rounded = scale * np.spacing((abs(start) + samples / rate) / scale)  # of the times in the file
    assert record.interval == pytest.approx(1 / rate, rel=1e-4, abs=2 * rounded / (samples - 1))
    np.testing.assert_allclose(record.voltage, voltage, rtol=1e-8, atol=1e-9)
    fitted = np.concatenate([np.r_[w] for w in problem.study.posterior.single_record.training])
    held = [np.r_[w] for v in problem.study.validations.values() for w in v.windows]
    assert all(window.size for window in held)
    every = np.sort(np.concatenate([fitted, *held]))
    np.testing.assert_array_equal(every, np.arange(samples))
    assert sum(window.size for window in held) in (0, *range(samples // 4 - 8, samples // 4 + 9))
    # A clock's time stamps count from the first sample; what they were is kept.
    assert abs(record.start) < 1e6
    assert record.start + record.time_offset == pytest.approx(start, abs=1 / rate)


@pytest.mark.parametrize("kind", ["sine", "decaying", "unipolar", "chirp", "triangle"])
@pytest.mark.parametrize("periods", [9.3, 40.0])
def test_what_is_held_out_is_like_the_rest(tmp_path: Path, kind: str, periods: float) -> None:
    """It has every amplitude and rate of the drive: it is no tail, and no end of a chirp."""
    voltage = drive(kind, periods, np.arange(4000) / 4000)
    path = written(tmp_path / "a.csv", voltage, moved(voltage, np.random.default_rng(0)))
    held = np.zeros(voltage.size, dtype=np.bool_)
    for window in resolved(path).study.validations["held_out"].windows:
        held[window] = True
    rates = np.abs(np.gradient(voltage))
    for values in (voltage, rates):
        assert stats.ks_2samp(values[held], values[~held]).statistic < 0.2
        assert np.ptp(values[held]) > 0.7 * np.ptp(values)


# The first minute, to its end: `bwbayes run FILE` on ordinary records and on instruments' files.
# 200 records of random length, rate, start, drive, size, units and separator are run to their
# report with a small budget; none may be refused. Whether such a short sampling converges is not
# asked here.


RECORDS = 200


def ordinary(folder: Path, number: int) -> Path:
    generator = np.random.default_rng([20261123, number])
    samples = int(np.exp(generator.uniform(np.log(200), np.log(8000))))
    kind = str(generator.choice(["sine", "decaying", "growing", "unipolar", "chirp", "triangle"]))
    voltage = drive(kind, generator.uniform(1.5, 20), np.arange(samples) / samples)
    size = float(np.exp(generator.uniform(np.log(0.01), np.log(10))))
    displacement = size * moved(voltage, generator) + generator.normal(0, 100)
    options: dict[str, Any] = {
        "rate": float(f"{10 ** generator.uniform(0, 5):.4g}"),
        "start": float(generator.choice([0.0, -1.5, 12.5, 3600.0, 1.7e9])),
        "units": tuple(str(generator.choice(list(table))) for table in UNITS.values()),
        "separator": str(generator.choice(SEPARATORS)),
    }
    return written(folder / f"record_{number}.csv", voltage, displacement, **options)


def ended(path: Path, folder: Path) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        config = draft_config(path, path.parent).config
        begun = RunFolder.create(folder / path.stem, resolve_config(config, path.parent))
        result = resume(begun, small.quiet(), workers=1, ess=100, steps=300)
    assert (begun.path / "report.html").is_file()
    return result.standing.status if result.outcome.converged else "not converged"


@pytest.mark.slow
def test_no_ordinary_record_is_refused(tmp_path: Path) -> None:
    counts: Counter[str] = Counter()
    refused = []
    for number in range(RECORDS):
        try:
            counts[ended(ordinary(tmp_path, number), tmp_path / "runs")] += 1
        except InputError as error:
            refused.append(f"{number}: {error}")
        print(number, dict(counts), refused[-1:], flush=True)
    keep("ordinary records", {"records": RECORDS, "refused": refused, **counts})
    assert not refused


def arguments(written: Written) -> list[str]:
    path, columns, units, fs = written
    said = [f"--column={name}={value}" for name, value in columns.items()]
    said += [f"--unit={name}={value}" for name, value in units.items()]
    return [str(path), *said, *([] if fs is None else [f"--fs={fs}"])]


@pytest.mark.slow
@pytest.mark.parametrize("name", INSTRUMENTS)
def test_no_file_of_an_instrument_is_refused(tmp_path: Path, name: str) -> None:
    given = arguments(INSTRUMENTS[name](tmp_path))
    run = ["run", *given, "--out", str(tmp_path / "run"), "--workers", "1", "--quiet"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        assert cli.main(run, standalone_mode=False) in {0, 3, 4, 5}
    assert (tmp_path / "run/report.html").is_file()

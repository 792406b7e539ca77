"""A command is played by a DAC, which holds it, whatever the voltage did in the record.

The quick test is as that of the bands in ``test_compensation.py``: 400 truths from the distribution
of five times as many draws, off by chance once in 1,000 runs. Its twin, a command for straight
lines that a DAC holds, comes half a sample late and is found. ``-m slow`` fits 40 seeds of a stand
whose voltage is measured, compensates, and plays the commands by a DAC.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs.control import export
from bwbayes.control.references import Reference, build_reference
from bwbayes.model.inputs import Hold
from tests.control.commands import (
    about,
    compensated,
    discrepancy,
    drawn,
    fit_of,
    inside,
    measured_voltage,
    off,
    played,
    problem,
    promised,
    study,
)

RATE, SEEDS, PLAYS = 200.0, 40, 5


@pytest.fixture(scope="module")
def measured() -> Run:
    return measured_voltage(RATE)


@pytest.fixture(scope="module")
def asked() -> Reference:
    return build_reference("triangle", 1 / RATE, 40.0, 2.0)


@pytest.mark.parametrize("fitted", ["command", "output"])
def test_by_default_a_command_is_for_a_dac(measured: Run, asked: Reference, fitted: str) -> None:
    """With the right model the stand is at the reference but for the DAC's steps of 0.1 V."""
    of = measured if fitted == "output" else problem()
    assert (
        "first" if fitted == "output" else "zero"
    ) == of.study.posterior.single_record.actuator.hold
    flat = about(of, 0.0, 2, np.random.default_rng(1))
    command = compensated(of, asked, flat)
    assert ("zero", "zoh", "command") == (
        command.hold,
        command.summary["hold"],
        command.record.voltage_is,
    )
    assert np.max(np.abs(played(asked, command.voltage) - command.smoothed)) < 0.1
    straight = compensated(of, asked, flat, hold="first")
    assert ("foh", "output") == (straight.summary["hold"], straight.record.voltage_is)
    assert np.max(np.abs(played(asked, straight.voltage) - straight.smoothed)) > 0.5


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_between_samples_the_displacement_is_where_it_is_said_to_be(
    measured: Run, asked: Reference, hold: Hold
) -> None:
    """Against the stand's actuator at a hundred times the rate."""
    flat = about(measured, 0.0, 2, np.random.default_rng(1))
    command = compensated(measured, asked, flat, hold=hold)
    actuator = replace(
        measured.study.posterior.single_record.actuator, interval=asked.interval / 100, hold=hold
    )
    samples, fine = np.arange(asked.time.size), np.arange(100 * (asked.time.size - 1) + 1) / 100
    voltage = np.interp(fine, samples, command.voltage)
    if hold == "zero":
        voltage = np.repeat(command.voltage, 100)[: fine.size]
    theta = measured.study.posterior.single_record.table.actuator(
        measured.study.posterior.prior.theta(flat[:1])
    )
    moved = actuator.displacement(theta, voltage, from_rest=True)[0]
    between = np.max(np.abs(moved - np.interp(fine, samples, moved[::100])))
    assert command.between == pytest.approx(between, rel=0.03)
    assert command.summary["between_samples_um"] == command.between
    # A command that does well at its samples alone says so.
    assert not any("shorter sampling interval" in remark for remark in command.remarks)
    flat[:, measured.study.posterior.names.index("discrepancy_sd")] = 1e-6
    smooth = Reference(asked.displacement, asked.interval)
    command = compensated(measured, smooth, flat, hold=hold)
    assert any("shorter sampling interval" in remark for remark in command.remarks)


def test_truths_are_where_a_command_for_a_dac_says(measured: Run, asked: Reference) -> None:
    """The twin goes in straight lines between samples as the measured voltage did; it is found."""
    source = np.random.default_rng(3)
    flat, truths = (about(measured, 0.005, count, source) for count in (2000, 400))
    result = off(promised(measured, compensated(measured, asked, flat), truths, source), 400)
    assert max(abs(value) for value in result.values()) < 4.0, result
    late = compensated(measured, asked, flat, hold="first")
    result = off(promised(measured, late, truths, source), 400)
    assert max(result["band", 95], result["rms", 95]) < -4.0, result


def test_a_model_is_exported_for_a_dac(measured: Run, tmp_path: Path) -> None:
    """The record's hold does not count, unless it is stated."""
    flat = about(measured, 0.001, 3, np.random.default_rng(1))
    held = export(fit_of(measured, flat), tmp_path / "held")
    straight = export(fit_of(measured, flat), tmp_path / "straight", hold="foh")
    assert ["zero", "first"] == [one.model.actuator.hold for one in (held, straight)]


def parts(seed: int) -> dict[tuple[str, int], float]:
    """Return what the bands held of a DAC's plays of a command for one fit."""
    of, source = measured_voltage(RATE, seed), np.random.default_rng(10_000 + seed)
    asked = build_reference("triangle", 1 / RATE, 40.0, 2.0, periods=16)
    command = compensated(of, asked, drawn(of))
    truth = played(asked, command.voltage)
    plays = [
        inside(command, truth + discrepancy(truth.size, asked.interval, source))
        for _ in range(PLAYS)
    ]
    return {key: float(np.mean([one[key] for one in plays])) for key in plays[0]}


@pytest.mark.slow
def test_forty_fits_to_measured_voltages_are_where_their_commands_say() -> None:
    """The 95% bands of the error cover 93 to 97%; all within three standard errors."""
    figures = study("compensation by a DAC", map(parts, range(SEEDS)))
    assert 0.93 <= figures["band 95"][0] <= 0.97, figures
    assert max(abs(error) for _, error in figures.values()) < 3.0, figures

"""``bwbayes track``: how well a displacement would be followed, with and without the model.

On the virtual test stand the posterior's draws are the actuators, and its mean is the model that a
controller has. Four files come of it: numbers (JSON), a table (CSV), a picture of error against
frequency (PNG), and a page.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bwbayes.app.figures import save_one
from bwbayes.app.figures.tracking import draw_tracking
from bwbayes.app.jobs.at_work import RunDraws, command_limits, drawn, refuse_existing
from bwbayes.app.jobs.export import at_rate
from bwbayes.app.problem.problem import generator
from bwbayes.app.report.track_report import render
from bwbayes.arrays import FloatArray
from bwbayes.control.gains import Robustness
from bwbayes.control.loop import LoopNoise, Stand
from bwbayes.control.tracking import Tracking, Wishes, track
from bwbayes.errors import InputError
from bwbayes.results.outputs import write_summary
from bwbayes.results.prediction import thinned

__all__ = ["Setup", "show", "track_draws", "track_run"]

# The controllers on a narrow screen.
SHORT = ("linear", "feed-forward", "PID", "both")

# Longest delay, samples.
LONGEST_DELAY = 100


@dataclass(frozen=True, kw_only=True)
class Setup:
    """A loop around a fitted actuator.

    Parameters
    ----------
    voltage
        Lowest and highest of the amplifier, V; by default zero and those of all records fitted.
    rate
        Samples a second.
    delay
        Whole samples from a reading to the command that answers it.
    gain_margin, phase_margin
        What every draw must keep: a factor, and degrees.
    frequencies
        Hz; by default from 0.1 Hz to where the dynamics matter.
    amplitude
        Of the references, um; by default 80 % of the mean model's reach.
    draws
        How many are simulated; the margins hold for a thousand.

    Raises
    ------
    InputError
        A delay, a number of draws or margins that make no sense.
    """

    voltage: tuple[float, float] | None = None
    rate: float = 1000.0
    delay: int = 1
    gain_margin: float = 2.0
    phase_margin: float = 60.0
    frequencies: tuple[float, ...] | None = None
    amplitude: float | None = None
    draws: int = 200

    def __post_init__(self) -> None:
        if not 0 <= self.delay <= LONGEST_DELAY:
            raise InputError(f"delay: {self.delay} samples; give 0 to {LONGEST_DELAY}")
        if self.draws < 2:
            raise InputError(f"draws: {self.draws} say nothing of how sure one may be; give more")
        _ = self.robustness

    @property
    def robustness(self) -> Robustness:
        """The margins."""
        return Robustness(self.gain_margin, self.phase_margin)


def track_draws(run: RunDraws, setup: Setup) -> Tracking:
    """Follow the paper's signals with the draws of a run for actuators.

    Raises
    ------
    InputError
        A model that cannot be stepped or inverted, or a setup that makes no sense.
    """
    problem, flat, standing = run
    posterior, seed = problem.posterior, problem.config.seed
    # Of several records the first: what belongs to a record matters little to a controller.
    one = posterior.datasets[0]
    every = thinned(flat, generator(seed, "draws"))
    theta = posterior.table.of(posterior.prior.theta(every), one.name)
    some = theta[: setup.draws]
    actuator = at_rate(one.actuator, setup.rate, "zero")
    stand = Stand(command_limits(problem, setup.voltage), setup.delay)
    wishes = Wishes(setup.robustness, setup.frequencies, setup.amplitude)
    made = track(
        actuator,
        one.table.actuator(some),
        _noise(one.table.columns(some)),
        stand,
        wishes,
        generator(seed, "track"),
        one.table.actuator(theta),
    )
    return replace(made, standing=standing)


def _noise(column: dict[str, FloatArray]) -> LoopNoise:
    """Return what the draws say of sensor and discrepancy; a white noise has none of the latter."""
    sensor = column["sensor_sd"]
    nothing, always = np.zeros_like(sensor), np.ones_like(sensor)
    return LoopNoise(
        sensor, column.get("discrepancy_sd", nothing), column.get("discrepancy_time", always)
    )


def track_run(
    path: Path, out: Path | None, setup: Setup, *, overwrite: bool = False
) -> tuple[Tracking, list[Path]]:
    """Track with the run in a folder, and write what came of it, by default to ``track`` in it.

    Raises
    ------
    NotConvergedError
        The sampling has not converged.
    InputError
        As :func:`track_draws`; or files exist, or cannot be written.
    """
    folder = out or path / "track"
    files = [folder / f"track.{kind}" for kind in ("json", "csv", "png", "html")]
    refuse_existing(files, overwrite)
    run = drawn(path)
    made = track_draws(run, setup)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        name = run.problem.config.name or run.problem.record.origin
        write_summary(files[0], {"name": name, **made.numbers()})
        made.to_pandas().to_csv(files[1], index=False)
        save_one(draw_tracking(made), files[2])
        files[3].write_text(render(name, made, files[2].read_bytes()), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; choose another folder") from None
    return made, files


def show(tracking: Tracking, console: Console) -> None:
    """Show gains, margins and the table of rms errors."""
    gains, margins = tracking.gains, tracking.margins
    lines = [
        f"PID: {gains.proportional:.3g} V/um, {gains.integral:.3g} V/(um s), "
        f"{gains.derivative:.3g} V s/um; {margins.gain.size} draws: gain margin at least "
        f"{margins.gain.min():.2f}, phase margin at least {margins.phase.min():.0f} degrees",
        f"references: {tracking.amplitude:.3g} um about {tracking.middle:.3g} um; jumps take "
        f"{1e3 * tracking.rise:.3g} ms",
    ]
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)
    table = Table(
        title="rms error, um, mean over the draws; and in how many both together are best"
    )
    for title in ("signal", "Hz", *SHORT, "best, %"):
        table.add_column(title, justify="left" if title == "signal" else "right")
    mean = tracking.rms.mean(axis=-1)
    for s, signal in enumerate(tracking.signals):
        for f, frequency in enumerate(tracking.frequencies):
            errors = [f"{one:.2f}" for one in mean[:, f, s]]
            best = f"{100 * tracking.best[f, s]:.0f}"
            table.add_row(signal, f"{frequency:g}", *errors, best)
    console.print(table)

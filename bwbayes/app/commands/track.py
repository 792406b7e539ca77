"""``bwbayes track``: how well a displacement would be followed, with and without the model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from bwbayes.app.commands.shared import (
    FILE,
    overwrite_option,
    present,
    quiet_option,
    voltage_option,
)

__all__ = ["track"]


@click.command()
@click.argument("folder", type=FILE)
@click.option("--out", type=FILE, help="Where the files go; default: FOLDER/track.")
@click.option(
    "--frequency",
    "frequencies",
    type=float,
    multiple=True,
    help="Of the references, Hz; may be given again; default: 0.1 Hz to where dynamics matter.",
)
@click.option("--amplitude", type=float, help="Of the references, um; default: 80 % of the reach.")
@voltage_option
@click.option("--rate", type=float, default=1000.0, show_default=True, help="Samples a second.")
@click.option(
    "--delay", type=int, default=1, show_default=True, help="Samples from reading to answer."
)
@click.option(
    "--gain-margin", type=float, default=2.0, show_default=True, help="That all draws keep."
)
@click.option(
    "--phase-margin",
    type=float,
    default=60.0,
    show_default=True,
    help="That all draws keep, degrees.",
)
@click.option("--draws", type=int, default=200, show_default=True, help="Simulated actuators.")
@overwrite_option
@quiet_option
def track(
    folder: Path,
    out: Path | None,
    frequencies: tuple[float, ...],
    overwrite: bool,
    quiet: bool,
    **options: Any,
) -> int:
    """Say how well the actuator of the run in FOLDER would follow the paper's signals.

    On the virtual test stand, with every draw of the posterior for actuator: a linear command, the
    mean model's inverse (feed-forward), a PID controller, and both together. 0 um is where the
    demagnetized actuator stands at zero volts; the default voltages are those fitted and 0 V.

    Example: bwbayes track results/ring_bender --frequency 1 --frequency 10
    """
    from bwbayes.app.fit.opening import converged
    from bwbayes.app.jobs.track import track as follow
    from bwbayes.report.saving import refuse_existing, save

    out = out or folder / "track"
    files = [out / f"track.{kind}" for kind in ("json", "csv", "png", "html")]
    refuse_existing(files, overwrite=overwrite)
    tracking = follow(converged(folder), frequencies=frequencies or None, **options)
    written = save(tracking.report(), out, "track")
    return present(tracking.report(), written, tracking.standing, quiet=quiet)

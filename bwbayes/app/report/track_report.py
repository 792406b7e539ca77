"""The page of a closed loop: margins, error against frequency, errors, gains, and the stand."""

from __future__ import annotations

from bwbayes.app.report.page import Table, picture, template
from bwbayes.control.tracking import CONTROLLERS, Tracking

__all__ = ["render"]

# Up to this frequency, Hz, feed-forward and feedback together are to be better than either, in at
# least this share of the draws.
JUDGED_TO, SHARE = 20.0, 0.95

CAPTION = (
    "Error against frequency",
    "Rms error of the actuator itself, not of the readings: the mean over the draws, and where "
    "95 % of them lie.",
)


def render(name: str, tracking: Tracking, png: bytes) -> str:
    """Return the page of a run's closed loop, with its picture."""
    margins, asked, stand = tracking.margins, tracking.robustness, tracking.stand
    judged = [f for f, one in enumerate(tracking.frequencies) if one <= JUDGED_TO]
    least = float(tracking.best[judged].min()) if judged else None
    better = least is not None and least >= SHARE
    low, high = margins.crossover.min(), margins.crossover.max()
    return template("track.html.j2").render(
        name=name,
        run_standing=tracking.standing,
        about=f"{tracking.rms.shape[-1]} draws of the posterior as actuators on the virtual test "
        "stand; its mean is the model that the controller has",
        margins=f"{margins.gain.size} draws: gain margin at least {margins.gain.min():.2f} (asked: "
        f"{asked.gain:g}), phase margin at least {margins.phase.min():.0f}° (asked: "
        f"{asked.phase:g}°), crossover at {low:.3g} to {high:.3g} Hz; by the circle criterion "
        "stable however the slope of the hysteresis changes",
        better=better,
        headline="Feedback and feed-forward together are best"
        if better
        else "Feedback and feed-forward together are not always best",
        compared=_compared(least),
        shown=picture(png, "error", *CAPTION),
        errors=_errors(tracking),
        gains=_gains(tracking),
        known=[
            ("references", f"{tracking.amplitude:.4g} µm about {tracking.middle:.3g} µm"),
            ("jumps", f"take {1e3 * tracking.rise:.3g} ms"),
            ("limits", f"{stand.limits.low:.4g} to {stand.limits.high:.4g} V"),
            ("sampling", f"every {1e3 * tracking.gains.interval:.3g} ms"),
            ("delay", f"in samples, from a reading to the command that answers it: {stand.delay}"),
            ("DAC", f"steps of {stand.amplifier.step:.3g} V, {stand.amplifier.slew:.3g} V/s"),
            ("ADC", f"steps of {stand.sensor.step:.3g} µm"),
            ("0 µm", "where the demagnetized actuator stands at zero volts"),
        ],
    )


def _compared(least: float | None) -> str:
    if least is None:
        return f"No frequency up to {JUDGED_TO:g} Hz was looked at."
    share = "all" if least == 1 else f"at least {100 * least:.0f} % of the"
    return (
        "PID with feed-forward has less rms error than PID alone and feed-forward alone in "
        f"{share} draws, on every signal up to {JUDGED_TO:g} Hz."
    )


def _errors(tracking: Tracking) -> Table:
    mean = tracking.rms.mean(axis=-1)
    rows = [
        (
            f"{signal}, {frequency:g} Hz",
            *(f"{one:.2f}" for one in mean[:, f, s]),
            f"{100 * tracking.best[f, s]:.0f}",
        )
        for s, signal in enumerate(tracking.signals)
        for f, frequency in enumerate(tracking.frequencies)
    ]
    return Table(
        "errors",
        "Rms error, µm, mean over the draws",
        ("Signal", *CONTROLLERS, "Both best, % of draws"),
        rows,
        records=tracking.rows(),
        note="The CSV has the spread over the draws, the largest errors, and how often the "
        "amplifier was at a limit.",
    )


def _gains(tracking: Tracking) -> Table:
    gains = tracking.gains
    first, second, third = gains.steps
    rows = [
        ("proportional", f"{gains.proportional:.5g}", "V/µm"),
        ("integral", f"{gains.integral:.5g}", "V/(µm s)"),
        ("derivative", f"{gains.derivative:.5g}", "V s/µm"),
        ("q₀", f"{first:.5g}", "V/µm"),
        ("q₁", f"{second:.5g}", "V/µm"),
        ("q₂", f"{third:.5g}", "V/µm"),
    ]
    return Table(
        "gains",
        "Gains",
        ("Gain", "Value", "Unit"),
        rows,
        note="u[t] = u[t−1] + q₀ e[t] + q₁ e[t−1] + q₂ e[t−2], kept within the limits together "
        "with what is fed forward. With feed-forward, e is what the mean model says of the fed "
        "command, less the reading.",
    )

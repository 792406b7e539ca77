"""How well four controllers follow: the numbers of a closed loop, and what is shown of them.

What :func:`~bwbayes.control.tracking.track` returns.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.gains import Gains, Margins, Robustness
from bwbayes.control.loop import Stand
from bwbayes.diagnosis.standing import Standing
from bwbayes.report.report import (
    Banner,
    Facts,
    Picture,
    Report,
    Section,
    Table,
    kind_of,
    standing_banner,
)
from bwbayes.shown import brief

__all__ = ["CONTROLLERS", "Tracking"]

CONTROLLERS = ("no compensation", "feed-forward", "PID", "PID with feed-forward")

# Up to this frequency, Hz, feed-forward and feedback together are to be better than either, in at
# least this share of the draws.
JUDGED_TO, SHARE = 20.0, 0.95


@dataclass(frozen=True)
class Tracking:
    """How well four controllers follow, for every draw.

    ``rms`` and ``largest`` error, um, and the share of samples ``limited`` by the amplifier are
    (controllers, frequencies, signals, draws), in the order of ``CONTROLLERS``, ``frequencies``,
    Hz, and ``signals``. The references swing by ``amplitude`` about the ``middle``, um; their jumps
    take the time ``rise``, s. ``standing`` is how the validation of the run came out that gave the
    draws, and ``name`` what it is called.
    """

    __repr__ = brief

    gains: Gains
    margins: Margins
    robustness: Robustness
    stand: Stand
    frequencies: tuple[float, ...]
    signals: tuple[str, ...]
    middle: float
    amplitude: float
    rise: float
    rms: FloatArray
    largest: FloatArray
    limited: FloatArray
    standing: Standing = field(default_factory=Standing)
    name: str = ""

    @property
    def best(self) -> FloatArray:
        """Share of the draws in which PID with feed-forward has less rms error than either alone.

        (frequencies, signals).
        """
        alone = np.minimum(self.rms[1], self.rms[2])
        share: FloatArray = np.mean(self.rms[3] < alone, axis=-1)
        return share

    def rows(self) -> list[dict[str, Any]]:
        """Return the table: a row for each signal, frequency and controller."""
        return [
            {
                "signal": signal,
                "frequency_Hz": frequency,
                "controller": controller,
                **_of("rms_um", self.rms[c, f, s]),
                **_of("largest_um", self.largest[c, f, s]),
                "limited": float(np.mean(self.limited[c, f, s])),
            }
            for s, signal in enumerate(self.signals)
            for f, frequency in enumerate(self.frequencies)
            for c, controller in enumerate(CONTROLLERS)
        ]

    def to_pandas(self) -> Any:
        """Return the table as a pandas.DataFrame."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        return pd.DataFrame(self.rows())

    def numbers(self) -> dict[str, Any]:
        """Return all of it for a summary, with units in the names."""
        gains, margins, stand = self.gains, self.margins, self.stand
        return {
            "name": self.name,
            "validation": self.standing.numbers,
            "controller": {
                "proportional_V_per_um": gains.proportional,
                "integral_V_per_um_s": gains.integral,
                "derivative_V_s_per_um": gains.derivative,
                "steps_V_per_um": list(gains.steps),
                "interval_s": gains.interval,
                "delay_samples": stand.delay,
            },
            "robustness": {
                "gain_margin_asked": self.robustness.gain,
                "phase_margin_asked_deg": self.robustness.phase,
                "gain_margin_least": float(margins.gain.min()),
                "phase_margin_least_deg": float(margins.phase.min()),
                "crossover_Hz": [float(margins.crossover.min()), float(margins.crossover.max())],
                "circle_criterion_least": float(margins.circle.min()),
                "stable": margins.stable,
                "draws": int(margins.gain.size),
            },
            "reference": {
                "middle_um": self.middle,
                "amplitude_um": self.amplitude,
                "rise_s": self.rise,
                "limits_V": list(stand.limits),
            },
            "draws": int(self.rms.shape[-1]),
            "best_share": [
                {"signal": signal, "frequency_Hz": frequency, "share": float(self.best[f, s])}
                for s, signal in enumerate(self.signals)
                for f, frequency in enumerate(self.frequencies)
            ],
            "table": self.rows(),
        }

    def report(self) -> Report:
        """Return margins, error against frequency, errors, gains and the stand, to be shown."""
        from bwbayes.report.figures.control import draw_tracking  # noqa: PLC0415

        table = self.to_pandas()
        title = "Error against frequency"
        caption = (
            "Rms error of the actuator itself, not of the readings: the mean over the draws, and "
            "where 95 % of them lie."
        )
        draw = partial(draw_tracking, table, CONTROLLERS)
        return Report(
            title=f"{self.name}, closed loop",
            heading=f"Closed loop: {self.name}",
            about=f"{self.rms.shape[-1]} draws of the posterior as actuators on the virtual test "
            "stand; its mean is the model that the controller has",
            banners=[*standing_banner(self.standing), self._stability(), self._comparison()],
            blocks=[
                Picture("track", title, caption, draw),
                Section("Errors", [self._errors()], folded=False),
                Section("The controller", [self._gains()], folded=False),
                Section("The test stand", [self._stand()], folded=False),
            ],
            numbers=self.numbers(),
            csv=table.to_csv(index=False),
        )

    def _stability(self) -> Banner:
        margins, requested = self.margins, self.robustness
        low, high = margins.crossover.min(), margins.crossover.max()
        line = (
            f"{margins.gain.size} draws: gain margin at least {margins.gain.min():.2f} (required: "
            f"{requested.gain:g}), phase margin at least {margins.phase.min():.0f}° (required: "
            f"{requested.phase:g}°), crossover at {low:.3g} to {high:.3g} Hz; by the circle "
            "criterion stable however the slope of the hysteresis changes"
        )
        return Banner(kind_of(self.standing), "Stable with every draw", [line])

    def _comparison(self) -> Banner:
        judged = [f for f, frequency in enumerate(self.frequencies) if frequency <= JUDGED_TO]
        if not judged:
            line = f"no frequency up to {JUDGED_TO:g} Hz was simulated"
            return Banner("note", "Feedback and feed-forward are not compared", [line])
        lowest = float(self.best[judged].min())
        share = "all" if lowest == 1 else f"at least {100 * lowest:.0f} % of the"
        is_best = lowest >= SHARE
        line = (
            "PID with feed-forward has less rms error than PID alone and feed-forward alone in "
            f"{share} draws, on every signal up to {JUDGED_TO:g} Hz"
        )
        headline = f"Feedback and feed-forward together are {'' if is_best else 'not always '}best"
        return Banner(kind_of(self.standing, good=is_best), headline, [line])

    def _errors(self) -> Table:
        mean = self.rms.mean(axis=-1)
        rows = [
            (
                f"{signal}, {frequency:g} Hz",
                *(f"{rms:.2f}" for rms in mean[:, f, s]),
                f"{100 * self.best[f, s]:.0f}",
            )
            for s, signal in enumerate(self.signals)
            for f, frequency in enumerate(self.frequencies)
        ]
        return Table(
            "errors",
            "Rms error, µm, mean over the draws",
            ("Signal", *CONTROLLERS, "Both best, % of draws"),
            rows,
            records=self.rows(),
            note="The CSV has the spread over the draws, the largest errors, and how often the "
            "amplifier was at a limit.",
            on="both",
        )

    def _gains(self) -> Table:
        gains = self.gains
        named = {
            "proportional": (gains.proportional, "V/µm"),
            "integral": (gains.integral, "V/(µm s)"),
            "derivative": (gains.derivative, "V s/µm"),
            **{f"q{i}": (step, "V/µm") for i, step in zip("₀₁₂", gains.steps, strict=True)},
        }
        return Table(
            "gains",
            "Gains",
            ("Gain", "Value", "Unit"),
            [(name, f"{value:.5g}", unit) for name, (value, unit) in named.items()],
            note="u[t] = u[t−1] + q₀ e[t] + q₁ e[t−1] + q₂ e[t−2], kept within the limits together "
            "with what is fed forward. With feed-forward, e is what the mean model says of the fed "
            "command, less the reading.",
            on="both",
        )

    def _stand(self) -> Facts:
        stand = self.stand
        return Facts(
            [
                ("references", f"{self.amplitude:.4g} µm about {self.middle:.3g} µm"),
                ("jumps", f"take {1e3 * self.rise:.3g} ms"),
                ("limits", f"{stand.limits.low:.4g} to {stand.limits.high:.4g} V"),
                ("sampling", f"every {1e3 * self.gains.interval:.3g} ms"),
                ("delay", f"samples from a reading to the command that answers it: {stand.delay}"),
                ("DAC", f"steps of {stand.amplifier.step:.3g} V, {stand.amplifier.slew:.3g} V/s"),
                ("ADC", f"steps of {stand.sensor.step:.3g} µm"),
                ("0 µm", "where the demagnetized actuator stands at zero volts"),
            ]
        )


def _of(name: str, values: FloatArray) -> dict[str, float]:
    """Return mean and 95 % interval over the draws."""
    low, high = np.quantile(values, [0.025, 0.975])
    return {name: float(values.mean()), f"{name}_low": float(low), f"{name}_high": float(high)}

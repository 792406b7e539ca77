"""How well a displacement is followed, with and without a model, for every draw of a posterior.

Four controllers are compared on the paper's signals, from slow to where the dynamics matter: a
linear command (no compensation), the mean model's inverse (feed-forward), a PID controller, and a
PID controller beside the feed-forward. The last one compares the reading with what the mean model
says the fed command does, so that it answers what the model does not know and nothing else.
All begin demagnetized at zero volts, and 0 um of a reference is where the actuator stands there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.control.compensation import facts_of
from bwbayes.control.loop import (
    CONTROLLERS,
    Gains,
    LoopNoise,
    Margins,
    Robustness,
    Stand,
    design,
    follow,
    plan_loops,
)
from bwbayes.control.references import TRACKED, tracking_signals
from bwbayes.control.sampled import SampledModel, require_inverse
from bwbayes.diagnosis.validation import ValidationSummary
from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.record.instruments import EXACT, Instruments
from bwbayes.report.report import (
    Banner,
    Facts,
    Picture,
    Product,
    Report,
    Section,
    Table,
    kind_of,
    standing_banner,
)
from bwbayes.shown import brief
from bwbayes.watching import WatchSteps, part, unwatched

# The amplitude of a sine behind dynamics that matter: half of its power.
LEFT = math.sqrt(0.5)


@dataclass(frozen=True)
class Tracking(Product):
    """How well four controllers follow, for every draw.

    ``rms`` and ``largest`` error, um, and the share of samples ``limited`` by the amplifier are
    (controllers, frequencies, signals, draws), in the order of ``CONTROLLERS``, ``frequencies``,
    Hz, and ``signals``. The references swing by ``amplitude`` about the ``middle``, um; their jumps
    take the time ``rise``, s. ``standing`` is how the validation of the run came out that gave the
    draws, ``name`` what it is called, ``instruments`` those that it was fitted with, and
    ``conditions`` the covariates.
    """

    NAME: ClassVar[str] = "track"
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
    standing: ValidationSummary = field(default_factory=ValidationSummary)
    name: str = ""
    instruments: Instruments = EXACT
    conditions: Mapping[str, float] = field(default_factory=dict)

    @property
    def best(self) -> FloatArray:
        """Share of the draws in which PID with feed-forward has less rms error than either alone.

        (frequencies, signals).
        """
        return np.asarray(np.mean(self.rms[3] < np.minimum(self.rms[1], self.rms[2]), axis=-1))

    @property
    def _cases(self) -> list[tuple[str, float, tuple[int, int]]]:
        """Each signal at each frequency, Hz, and where their errors are."""
        return [
            (signal, frequency, (f, s))
            for s, signal in enumerate(self.signals)
            for f, frequency in enumerate(self.frequencies)
        ]

    def rows(self) -> list[dict[str, Any]]:
        """Return the table: a row for each signal, frequency and controller."""
        return [
            {
                "signal": signal,
                "frequency_Hz": frequency,
                "controller": controller,
                **_mean_and_interval("rms_um", self.rms[c][at]),
                **_mean_and_interval("largest_um", self.largest[c][at]),
                "limited": float(np.mean(self.limited[c][at])),
            }
            for signal, frequency, at in self._cases
            for c, controller in enumerate(CONTROLLERS)
        ]

    def to_pandas(self) -> Any:
        """Return the table as a pandas.DataFrame."""
        import pandas as pd  # noqa: PLC0415  # slow to load, and only needed here

        return pd.DataFrame(self.rows())

    def numbers(self) -> dict[str, Any]:
        """Return all of it for a summary, with units in the names."""
        gains, margins = self.gains, self.margins
        return {
            "name": self.name,
            "validation": self.standing.numbers,
            "controller": {
                "proportional_V_per_um": gains.proportional,
                "integral_V_per_um_s": gains.integral,
                "derivative_V_s_per_um": gains.derivative,
                "steps_V_per_um": list(gains.steps),
                "interval_s": gains.interval,
                "delay_samples": self.stand.delay,
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
                **self.stand.allowed.numbers,
            },
            "conditions": dict(self.conditions),
            "draws": int(self.rms.shape[-1]),
            "best_share": [
                {"signal": signal, "frequency_Hz": frequency, "share": float(self.best[at])}
                for signal, frequency, at in self._cases
            ],
            "table": self.rows(),
        }

    def report(self) -> Report:
        """Return margins, error against frequency, errors, gains and the stand, to be shown."""
        from bwbayes.report.figures.products import draw_tracking  # noqa: PLC0415

        table, margins, requested = self.to_pandas(), self.margins, self.robustness
        stable = (
            f"{margins.gain.size} draws: gain margin at least {margins.gain.min():.2f} (required: "
            f"{requested.gain:g}), phase margin at least {margins.phase.min():.0f}° (required: "
            f"{requested.phase:g}°), crossover at {margins.crossover.min():.3g} to "
            f"{margins.crossover.max():.3g} Hz; by the circle criterion stable however the slope "
            "of the hysteresis changes, while the amplifier is at none of its limits"
        )
        picture = Picture(
            "track",
            "Error against frequency",
            "Rms error of the actuator itself, not of the readings: the mean over the draws, and "
            "where 95% of them lie.",
            partial(draw_tracking, table, CONTROLLERS),
        )
        return Report(
            title=f"{self.name}, closed loop",
            heading=f"Closed loop: {self.name}",
            about=f"{self.rms.shape[-1]} draws of the posterior as actuators on the virtual test "
            "stand; its mean is the model that the controller has",
            banners=[
                *standing_banner(self.standing),
                Banner(kind_of(self.standing), "Stable with every draw", [stable]),
                self._comparison(),
            ],
            blocks=[
                Facts([("amplifier", str(self.stand.allowed)), *facts_of(self.conditions)]),
                picture,
                Section("Errors", [self._errors()], folded=False),
                Section("The controller", [self._gains()], folded=False),
                Section("The test stand", [self._stand()], folded=False),
            ],
            numbers=self.numbers(),
            csv=table.to_csv(index=False),
        )

    def _comparison(self) -> Banner:
        """Say whether feedback and feed-forward together are best in 95% of the draws or more."""
        highest, required = 20.0, 0.95  # Hz, and a share
        shares = [self.best[at] for _, frequency, at in self._cases if frequency <= highest]
        if not shares:
            line = f"no frequency up to {highest:g} Hz was simulated"
            return Banner("note", "Feedback and feed-forward are not compared", [line])
        lowest = min(shares)
        share = "all" if lowest == 1 else f"at least {100 * lowest:.0f}% of the"
        is_best = bool(lowest >= required)
        line = (
            "PID with feed-forward has less rms error than PID alone and feed-forward alone in "
            f"{share} draws, on every signal up to {highest:g} Hz"
        )
        headline = f"Feedback and feed-forward together are {'' if is_best else 'not always '}best"
        return Banner(kind_of(self.standing, good=is_best), headline, [line])

    def _errors(self) -> Table:
        rows = []
        for signal, frequency, at in self._cases:
            errors = (f"{rms[at].mean():.3g}" for rms in self.rms)
            rows.append((f"{signal}, {frequency:g} Hz", *errors, f"{100 * self.best[at]:.0f}"))
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
        rows = [
            ("proportional", f"{gains.proportional:.5g}", "V/µm"),
            ("integral", f"{gains.integral:.5g}", "V/(µm s)"),
            ("derivative", f"{gains.derivative:.5g}", "V s/µm"),
            *((f"q{i}", f"{step:.5g}", "V/µm") for i, step in zip("₀₁₂", gains.steps, strict=True)),
        ]
        return Table(
            "gains",
            "Gains",
            ("Gain", "Value", "Unit"),
            rows,
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
                ("sampling", f"every {1e3 * self.gains.interval:.3g} ms"),
                ("delay", f"samples from a reading to the command that answers it: {stand.delay}"),
                ("DAC", f"steps of {stand.amplifier.step:.3g} V"),
                ("ADC", f"steps of {stand.sensor.step:.3g} µm"),
                ("0 µm", "where the demagnetized actuator stands at zero volts"),
                *self.instruments.facts.items(),
            ]
        )


def _mean_and_interval(name: str, values: FloatArray) -> dict[str, float]:
    """Return mean and 95% interval over the draws."""
    low, high = np.quantile(values, [0.025, 0.975])
    return {name: float(values.mean()), f"{name}_low": float(low), f"{name}_high": float(high)}


def track(
    actuator: Actuator,
    theta: FloatArray,
    noise: LoopNoise,
    stand: Stand,
    generator: np.random.Generator,
    *,
    robustness: Robustness | None = None,
    frequencies: Sequence[float] | None = None,
    amplitude: float | None = None,
    all_theta: FloatArray | None = None,
    true: Callable[[FloatArray], FloatArray] = np.positive,
    watch: WatchSteps = unwatched,
) -> Tracking:
    """Follow the paper's signals with four controllers.

    The ``actuator`` has parts and the controller's interval; its voltage is held. ``theta`` (draws,
    parameters) are the actuators that are simulated, each with its ``noise``; ``all_theta`` all
    draws that the controller must be stable with, and whose mean is the model, by default the same.
    ``frequencies``, Hz, are by default 1, 2 and 5 of each decade from 0.1 Hz to where the mean
    model's dynamics leave 71% of a sine, or to a tenth of the samples; the ``amplitude``, um, is by
    default 80% of what the mean model reaches. ``true`` returns the displacements that readings
    (..., draws), um, stand for, by default the same. ``watch`` is called with the name of a step
    and the share of it that is done.

    Raises InputError: a model that has no step or no inverse, margins that cannot be had,
    frequencies that are too fast or too slow, or an amplitude that is out of reach.
    """
    robustness, limits = robustness or Robustness(), stand.limits.span
    all_theta = theta if all_theta is None else all_theta
    mean_theta = all_theta.mean(axis=0)
    mean = SampledModel.of(actuator, mean_theta[np.newaxis])
    require_inverse(mean, limits)
    frequencies = _frequencies(mean, frequencies)
    ends = mean.reach(limits)
    if amplitude is None:
        amplitude = 0.8 * ends.half
    elif not 0 < amplitude <= ends.half:
        raise InputError(
            f"amplitude: {amplitude:g} um; give one above 0 and within the mean model's reach, "
            f"which is {ends.half:.3g} um about {ends.middle:.3g} um"
        )
    # A range about zero needs no way to its middle.
    center = ends.middle if abs(ends.middle) > 1e-3 * amplitude else 0.0
    # How many samples a jump of a reference is to take. A lag τ needs w = x + τ x′. A jump by two
    # amplitudes that takes four times τ, with a speed that is a Hann window, stays within the reach
    # that the amplitude is 80% of.
    turns = np.geomspace(1e-4, np.pi, 400)
    slow = turns[np.abs(mean.frequency_response(turns))[0] < LEFT]
    rise = max(round(4 / float(slow[0])), 1) if slow.size else 1
    draws = SampledModel.of(actuator, all_theta)
    gains, margins = design(mean, draws, limits, stand.delay, robustness)
    references = [
        tracking_signals(frequency, actuator.interval, center, amplitude, rise)
        for frequency in frequencies
    ]
    signals = tuple(TRACKED)
    models = SampledModel.of(actuator, np.tile(mean_theta, (len(frequencies) * len(signals), 1)))
    rows = SampledModel.of(actuator, np.tile(theta, (len(CONTROLLERS) * len(signals), 1)))
    # The number of samples tells how much is still to be followed.
    shares = np.cumsum([0, *(desired.shape[1] for desired, _ in references)])
    shares = shares / shares[-1]
    plans = plan_loops(models, references, ends, stand, partial(watch, "feed-forward"))
    loops = partial(watch, "closed loops")
    errors = [
        follow(
            plan, gains, rows, noise, stand, generator, part(loops, *shares[at : at + 2]), true=true
        )
        for at, plan in enumerate(plans)
    ]
    rms, largest, limited = (np.stack(values, axis=1) for values in zip(*errors, strict=True))
    return Tracking(
        gains, margins, robustness, stand, frequencies, signals, center, amplitude,
        rise * actuator.interval, rms, largest, limited, conditions=actuator.conditions,
    )  # fmt: skip


def _frequencies(mean: SampledModel, frequencies: Sequence[float] | None) -> tuple[float, ...]:
    """Return the frequencies, Hz: those requested, or 1, 2 and 5 of each decade from 0.1 Hz.

    A period has ten samples or more, and a signal at most a million.
    """
    interval = mean.actuator.interval
    slowest, fastest = 3e-6 / interval, 0.1 / interval
    if frequencies is not None:
        for frequency in frequencies:
            if not slowest <= frequency <= fastest:
                raise InputError(
                    f"frequencies: {frequency:g} Hz; at this rate give some from {slowest:.3g} to "
                    f"{fastest:.3g} Hz"
                )
        if not frequencies:
            raise InputError("frequencies: none is given; give some in Hz")
        return tuple(frequencies)
    decades = range(-1, math.ceil(math.log10(fastest)) + 1)
    steps_of_rate = [round(digit * 10.0**decade, 12) for decade in decades for digit in (1, 2, 5)]
    allowed = np.array([frequency for frequency in steps_of_rate if frequency <= fastest])
    response = np.abs(mean.frequency_response(2 * np.pi * interval * allowed))[0]
    # The first one at which the dynamics matter is the last.
    return tuple(allowed[: 1 + np.count_nonzero(np.cumprod(response >= LEFT))].tolist())

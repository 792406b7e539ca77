"""Loops of other quantities: each run by one line, in its own words and units, and back again."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import bwbayes as bw
from bwbayes.arrays import FloatArray
from bwbayes.model.actuator import Actuator
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.quantities import Quantities
from bwbayes.report.report import as_text
from tests.app.conftest import Type

# Of alpha/d, and of beta and gamma times the amplitude.
ALPHA, BETA, GAMMA = 0.6, 2.5, 1.5


@dataclass(frozen=True)
class Loop:
    """A loop that decays: its quantities, the columns of its file, and what it is made of."""

    input: str
    output: str
    columns: tuple[str, str]
    amplitude: float  # of the input, in its unit
    slope: float  # d, in the output's unit per input's
    factors: tuple[float, float] = (1.0, 1.0)  # of the numbers in the file
    interval: float | None = None

    @property
    def truth(self) -> dict[str, float]:
        """The true parameters, by name."""
        rates = {"beta": BETA / self.amplitude, "gamma": GAMMA / self.amplitude}
        return {"d": self.slope, "alpha": ALPHA * self.slope, **rates}

    def follow(self, driven: FloatArray) -> FloatArray:
        """Return what comes out, from the demagnetized state."""
        actuator = Actuator("none", "first", 1.0, BoucWen())
        values = {"exponent": 1.0, "initial": 0.0, **self.truth}
        theta = np.array([[values.get(d.name, 0.0) for d in actuator.declarations]])
        out: FloatArray = actuator.displacement(theta, driven)[0]
        return out

    def write(self, path: Path) -> None:
        """Write a file with noise of 0.4% of the range."""
        phase = np.linspace(0, 1, 900)
        driven = self.amplitude * np.sin(2 * np.pi * 6 * phase) * (1 - 0.6 * phase)
        out = self.follow(driven)
        out = out + 0.004 * np.ptp(out) * np.random.default_rng(1).standard_normal(out.size)
        numbers: dict[str, Any] = {
            name: series * factor
            for name, series, factor in zip(self.columns, (driven, out), self.factors, strict=True)
        }
        if self.interval is not None:
            numbers = {"time (s)": self.interval * np.arange(out.size), **numbers}
        pd.DataFrame(numbers).to_csv(path, index=False)


LOOPS = {
    "magnet": Loop("H (A/m)", "B (T)", ("H [kA/m]", "B [mT]"), 300.0, 0.004, (1e-3, 1e3)),
    "force": Loop(
        "displacement (mm)", "force (kN)", ("displacement (mm)", "load_N"), 20.0, 0.5, (1.0, 1e3)
    ),
    "ferroelectric": Loop("E (kV/cm)", "P (uC/cm2)", ("E (V/m)", "P"), 40.0, 0.75, (1e5, 1.0)),
    "muscle": Loop(
        "pressure (bar)", "length (mm)", ("pressure_bar", "length_mm"), 3.0, 6.0, interval=0.01
    ),
}
# The package's own words and units.
OWN = re.compile(r"\b([vV]oltages?|[dD]isplacements?|um|µm|V|volts?|piezo\w*)\b(?![=_])")


@pytest.mark.usefixtures("_without_pictures", "_without_explanations")
@pytest.mark.filterwarnings("ignore::bwbayes.errors.InputWarning")  # that a start is smoothed
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ("magnet", "muscle") else pytest.mark.slow)
        for name in LOOPS
    ],
)
def test_a_loop_of_any_quantities_is_run_by_one_line_in_its_own_units(
    name: str, bwbayes: Type
) -> None:
    """Parameters within 4 SDs of the truth (a chance of 2e-4 to fail); commands to 2% of the range.

    Files are in other units than the run, which is told apart by their names alone. One without a
    time and one with it are in the default suite, all with ``-m slow``.
    """
    loop, quantities = LOOPS[name], Quantities.of(LOOPS[name].input, LOOPS[name].output)
    loop.write(Path("loop.csv"))
    stated = ("--input", loop.input, "--output", loop.output)
    said = bwbayes("run", "loop.csv", *stated, "--search", "none", "--out", "run")
    assert (said.status, "no time" in said.out) == (0, loop.interval is None), said
    numbers = json.loads(Path("run/summary.json").read_text(encoding="utf-8"))
    unit = {"d": f"{quantities.say('um/V')}", "beta": f"{quantities.say('1/V')}"}
    for parameter, true in loop.truth.items():
        estimate = numbers["parameters"][parameter]
        assert abs(estimate["mean"] - true) < 4 * estimate["sd"]
        assert estimate["unit"] == unit.get(parameter, estimate["unit"])
    timed = {"lag", "discrepancy_time"} & numbers["parameters"].keys()
    assert bool(timed) == (loop.interval is not None)
    fit = bw.open_run("run")
    amplitude, frequency = 0.3 * loop.slope * loop.amplitude, 0.005 / (loop.interval or 1.0)
    compensation = fit.compensate("sine", amplitude=amplitude, frequency=frequency, from_rest=True)
    compensation.save("command")
    exported = fit.export()
    exported.save("exported")
    files = ["run/report.html", "run/bands.csv", "run/summary.json", "exported/model.json"]
    files += ["exported/actuator.c"]
    files += ["command/compensation.html", "command/compensation.csv", "command/command.csv"]
    texts = {file: Path(file).read_text(encoding="utf-8") for file in files}
    texts |= {"screen": said.out, "fit": as_text(fit.full_report())}
    # "displacement" is the package's word for an output; here it may be the input.
    inside = {word.rstrip("s") for word in re.findall(OWN, f"{loop.input} {loop.output}")}
    for place, text in texts.items():
        plain = re.sub(r"<script.*?</script>|<style.*?</style>|data:[^\"]*", "", text, flags=re.S)
        assert {word.lower().rstrip("s") for word in re.findall(OWN, plain)} <= inside, place
    command = bw.read_record("command/command.csv", need_displacement=False)
    assert command.quantities == fit.quantities
    reference, out = compensation.smoothed, loop.follow(command.voltage)
    assert np.max(np.abs(out - reference)) < 0.02 * np.ptp(reference)

"""The posterior written a second time, slowly and plainly, without anything of the package.

One model at a time, one sample at a time: the hysteresis by the solution of its equation over one
step of the voltage, the dynamics by the matrix exponential of the system and its drive together,
the noise by a Kalman filter from the discrepancy's stationary distribution, the prior by scipy's
densities. It reads the same configs as the package does, as far as the cases here need them: every
prior given, a record in a CSV file, exponent one, discrepancy noise.
"""

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import expm

Floats = NDArray[np.float64]

FOLDER = Path(__file__).resolve().parent

# It is no part of the project, but lies beside the repository, or what needs it is left out.
MEASURED = FOLDER.parents[2] / "shared" / "data" / "picma_stack_open_loop.csv"

MODEL = ("d", "alpha", "beta", "gamma", "exponent", "initial")
DYNAMICS = {"none": (), "lag": ("lag",), "second-order": ("mass", "damping", "stiffness")}
NOISE = ("sensor_sd", "discrepancy_sd", "discrepancy_time")
POSITIVE = ("d", "alpha", "beta", "lag", "damping", *NOISE)


@dataclass(frozen=True)
class Case:
    """A record, a model and its priors: what a config says.

    ``voltage`` (samples,), V; ``displacement`` (samples,), um; ``interval``, s; ``training``, the
    slices that count; ``names`` of all parameters; ``priors`` of the free ones, each the name of a
    distribution and its arguments; ``fixed`` values of the others; ``from_rest``, that the record
    starts with an actuator at rest.
    """

    voltage: Floats
    displacement: Floats
    interval: float
    training: tuple[slice, ...]
    dynamics: str
    hold: str
    names: tuple[str, ...]
    priors: Mapping[str, tuple[str, tuple[float, ...]]]
    fixed: Mapping[str, float]
    from_rest: bool = True

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free parameters, in order."""
        return tuple(name for name in self.names if name in self.priors)


def hysteresis(voltage: Floats, alpha: float, beta: float, gamma: float, initial: float) -> Floats:
    """Follow h (samples,) in um by dh = alpha du - beta |du| h - gamma du |h|, step by step."""
    h = np.empty(voltage.size)
    h[0] = initial
    for t in range(1, voltage.size):
        sign = 1.0 if voltage[t] > voltage[t - 1] else -1.0
        left = abs(voltage[t] - voltage[t - 1])
        # With g = s h and v = |du|: dg/dv = alpha - c g, c = beta + gamma where g > 0.
        g = sign * h[t - 1]
        if g < 0:
            c = beta - gamma
            crossing = math.log1p(-c * g / alpha) / c if c != 0 else -g / alpha
            if crossing > left:
                gone = -math.expm1(-c * left) / c if c != 0 else left
                g, left = g + (alpha - c * g) * gone, 0.0
            else:
                g, left = 0.0, left - crossing
        c = beta + gamma
        gone = -math.expm1(-c * left) / c if c != 0 else left
        h[t] = sign * (g + (alpha - c * g) * gone)
    return h


def dynamics(drive: Floats, old: Floats, now: Floats, step: Floats) -> Floats:
    """Displacement (samples,) of a system that is at rest at the first drive (samples,).

    x[t] = old x[t-1] + now w[t-1] + step (w[t] - w[t-1]); its first state is the displacement.
    """
    states = now.size
    state = np.zeros(states)
    state[0] = drive[0]
    displacement = np.empty(drive.size)
    displacement[0] = drive[0]
    for t in range(1, drive.size):
        after = np.zeros(states)
        for i in range(states):
            after[i] = now[i] * drive[t - 1] + step[i] * (drive[t] - drive[t - 1])
            for j in range(states):
                after[i] += old[i, j] * state[j]
        state = after
        displacement[t] = state[0]
    return displacement


def kalman(
    residual: Floats, interval: float, sensor: float, discrepancy: float, time: float
) -> float:
    """Log density of a residual (samples,): each sample given those before it."""
    kept = math.exp(-interval / time)
    mean, variance, total = 0.0, discrepancy**2, 0.0
    for t in range(residual.size):
        spread = variance + sensor**2
        surprise = residual[t] - mean
        total -= 0.5 * (surprise**2 / spread + math.log(2 * math.pi * spread))
        mean += variance / spread * surprise
        variance *= sensor**2 / spread
        mean *= kept
        variance = kept**2 * variance + (1 - kept**2) * discrepancy**2
    return total


@dataclass(frozen=True)
class Loops:
    """The three loops over samples, so that a script may compile them as they stand."""

    hysteresis: Callable[[Floats, float, float, float, float], Floats] = hysteresis
    dynamics: Callable[[Floats, Floats, Floats, Floats], Floats] = dynamics
    kalman: Callable[[Floats, float, float, float, float], float] = kalman


PLAIN = Loops()


def transition(case: Case, theta: Mapping[str, float]) -> tuple[Floats, Floats, Floats]:
    """Transition over an interval: of the state, of a held drive, of a ramp to one.

    The system x' = A x + B w is joined with its drive, w' = r and r' = 0, and the whole goes
    through one matrix exponential.
    """
    if case.dynamics == "lag":
        system, inlet = np.array([[-1.0]]), np.array([1.0])
        scale = 1 / theta["lag"]
    else:
        # The velocity over the natural frequency as second state keeps both of one size.
        scale = math.sqrt(theta["stiffness"] / theta["mass"])
        loss = theta["damping"] / math.sqrt(theta["stiffness"] * theta["mass"])
        system, inlet = np.array([[0.0, 1.0], [-1.0, -loss]]), np.array([0.0, 1.0])
    states = inlet.size
    joined = np.zeros((states + 2, states + 2))
    joined[:states, :states] = system * (scale * case.interval)
    joined[:states, states] = inlet * (scale * case.interval)
    joined[states, states + 1] = 1.0 if case.hold == "first" else 0.0
    whole = expm(joined)
    parts = whole[:states, :states], whole[:states, states], whole[:states, states + 1]
    old, now, step = (np.ascontiguousarray(part) for part in parts)
    return old, now, step


def simulate(case: Case, theta: Mapping[str, float], loops: Loops = PLAIN) -> Floats:
    """Displacement (samples,) in um of the model with parameters ``theta``."""
    shape = (theta[name] for name in ("alpha", "beta", "gamma", "initial"))
    displacement = theta["d"] * case.voltage - loops.hysteresis(case.voltage, *shape)
    if case.dynamics != "none":
        displacement = loops.dynamics(displacement, *transition(case, theta))
    return displacement + theta["offset"]


def log_likelihood(case: Case, theta: Mapping[str, float], loops: Loops = PLAIN) -> float:
    """Log likelihood at all parameters, free and fixed, by name; one training window.

    Unless the record starts from rest, the lag has a distance c from rest at its first sample, with
    a prior sd of d times half the voltage's range. The log density is quadratic in c, so three
    values of c give it whole, and its integral.
    """
    (part,) = case.training
    residual = (case.displacement - simulate(case, theta, loops))[part]
    noise = [theta[name] for name in NOISE]
    usual = loops.kalman(residual, case.interval, *noise)
    if case.from_rest:
        return usual
    spread = theta["d"] * float(np.ptp(case.voltage)) / 2
    time = case.interval * np.arange(case.voltage.size)[part]
    response = spread * np.exp(-time / theta["lag"])
    more, less = (loops.kalman(residual - c * response, case.interval, *noise) for c in (1.0, -1.0))
    slope, bend = (more - less) / 2, 2 * usual - more - less
    return usual + slope**2 / (2 * (1 + bend)) - math.log(1 + bend) / 2


def log_prior(case: Case, theta: Mapping[str, float]) -> float:
    """Log of the prior's density, up to a constant; -inf outside the physical constraints."""
    if not inside(theta):
        return -math.inf
    return sum(float(frozen(*case.priors[name]).logpdf(theta[name])) for name in case.free)


def inside(theta: Mapping[str, float]) -> bool:
    """Tell whether 0 < alpha < d, |gamma| <= beta, and the initial state is under the ceiling."""
    positive = all(theta[name] > 0 for name in POSITIVE if name in theta)
    possible = theta["alpha"] < theta["d"] and abs(theta["gamma"]) <= theta["beta"]
    reach = abs(theta["initial"]) * (theta["beta"] + theta["gamma"])
    return positive and possible and reach <= theta["alpha"]


def frozen(distribution: str, arguments: tuple[float, ...]) -> Any:
    """Return scipy's distribution of one of the names and arguments that configs use."""
    match distribution:
        case "normal":
            return stats.norm(*arguments)
        case "lognormal":
            median, sigma = arguments
            return stats.lognorm(sigma, scale=median)
        case "halfnormal":
            return stats.halfnorm(scale=arguments[0])
    raise ValueError(f"{distribution}: not among the priors of the reference cases")


def load_case(path: Path) -> Case:
    """Read a case from a config whose record lies relative to it."""
    config = tomllib.loads(path.read_text(encoding="utf-8"))
    source, model = config["record"], config["model"]
    time, voltage, displacement = read_csv(path.parent / source["file"])
    begin = rows(time, source.get("start", time[0]), source.get("stop", math.inf))
    kept = slice(begin.start, begin.stop, source.get("decimate", 1))
    time, voltage, displacement = time[kept], voltage[kept], displacement[kept]
    names = (*MODEL, *DYNAMICS[model["dynamics"]], "offset", *NOISE)
    given = config["parameters"]
    priors = {
        name: (prior.pop("distribution"), tuple(prior.values()))
        for name in names
        if (prior := given[name].get("prior")) is not None
    }
    return Case(
        voltage,
        displacement,
        float(time[-1] - time[0]) / (time.size - 1),
        tuple(rows(time, *window) for window in source.get("train", [[time[0], math.inf]])),
        model["dynamics"],
        model["hold"],
        names,
        priors,
        {name: given[name]["fixed"] for name in names if name not in priors},
        source.get("from_rest", False),
    )


def read_csv(path: Path) -> tuple[Floats, Floats, Floats]:
    """Return time in s, voltage in V and displacement in um of a CSV file, each (samples,)."""
    lines = path.read_text(encoding="utf-8").splitlines()
    table = np.loadtxt([line for line in lines if line[0] not in "#t"], delimiter=",")
    return table[:, 0].copy(), table[:, 1].copy(), table[:, 2].copy()


def rows(time: Floats, start: float, stop: float) -> slice:
    """Return the slice of the samples with start <= time < stop, times being a little rounded."""
    result = np.flatnonzero((time > start - 1e-6) & (time < stop - 1e-6))
    return slice(int(result[0]), int(result[-1]) + 1)

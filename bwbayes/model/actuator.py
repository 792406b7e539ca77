"""The actuator: voltage in, displacement out, for a batch of parameter vectors at once.

Hysteresis takes its part of the drive, w = d u − h, linear dynamics follow the drive, and the
sensor adds its offset (equations (6) to (8) of the paper). An :class:`Actuator` says which dynamics
there are, what the voltage does between samples, and how long those are apart; the parameters come
as the columns of a matrix θ. A long record can be walked through in pieces: the
:class:`State` at the end of one piece starts the next.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from bwbayes.arrays import ArrayLike, FloatArray
from bwbayes.errors import InputError
from bwbayes.model.boucwen import hysteresis
from bwbayes.model.linear import Hold, Recursion, first_order_lag, no_dynamics, second_order

__all__ = ["Actuator", "Dynamics", "State"]

Dynamics = Literal["none", "lag", "second-order"]

HYSTERESIS_PARAMETERS = ("d", "alpha", "beta", "gamma", "exponent", "initial")


@dataclass(frozen=True)
class State:
    """All that a batch of models remembers after a piece of a record.

    ``voltage`` is the last sample in V; ``hysteretic`` is h there, (models,), um; ``rest`` is the
    drive at the record's first sample, at which the dynamics were at rest, (models,), um;
    ``filter`` is the state of the recursion, (models, taps - 1).
    """

    voltage: float
    hysteretic: FloatArray
    rest: FloatArray
    filter: FloatArray


@dataclass(frozen=True)
class Actuator:
    """A Bouc-Wen actuator with linear dynamics.

    Parameters
    ----------
    dynamics
        ``"none"``; ``"lag"``, one first-order lag; ``"second-order"``, equation (7).
    hold
        ``"first"``: the drive goes straight from sample to sample (a measured voltage);
        ``"zero"``: it is held until the next sample (the command of a DAC).
    interval
        Sampling interval, s, above zero.

    Raises
    ------
    InputError
        An unknown ``dynamics`` or ``hold``, or an ``interval`` that is not positive and finite.
    """

    dynamics: Dynamics = "lag"
    hold: Hold = "first"
    interval: float = 1e-3

    def __post_init__(self) -> None:
        for name, value, known in (
            ("dynamics", self.dynamics, get_args(Dynamics)),
            ("hold", self.hold, get_args(Hold)),
        ):
            if value not in known:
                raise InputError(f"{name}: {value!r} is unknown; write one of {', '.join(known)}")
        if not 0 < self.interval < math.inf:
            raise InputError(f"interval: {self.interval:.6g}; must be positive and finite, in s")

    @property
    def dynamics_parameters(self) -> tuple[str, ...]:
        """Names of the parameters of the dynamics."""
        names: dict[Dynamics, tuple[str, ...]] = {
            "none": (),
            "lag": ("lag",),
            "second-order": ("mass", "damping", "stiffness"),
        }
        return names[self.dynamics]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of θ's columns."""
        return (*HYSTERESIS_PARAMETERS, *self.dynamics_parameters, "offset")

    @property
    def unknowns(self) -> int:
        """How many numbers say in which state the dynamics are at a record's first sample."""
        states: dict[Dynamics, int] = {
            "none": int(self.hold == "zero"),
            "lag": 1,
            "second-order": 2,
        }
        return states[self.dynamics]

    def displacement(self, theta: ArrayLike, voltage: ArrayLike) -> FloatArray:
        """Displacement of every model along one voltage.

        Parameters
        ----------
        theta
            (models, parameters), the columns as in :attr:`parameters`: d, α in um/V; β, γ in
            um^(1−n)/V; n; initial h in um; the lag in s, or mass, damping, stiffness in kg, N s/m,
            N/m; offset in um.
        voltage
            (samples,), V.

        Returns
        -------
        FloatArray
            (models, samples), um.

        Raises
        ------
        InputError
            θ of a wrong shape or outside the model's domain: not finite, mass or stiffness not
            positive, lag or damping negative, and what
            :func:`~bwbayes.model.boucwen.hysteresis` refuses. The text names the parameter.
        """
        return self.advance(theta, voltage)[0]

    def advance(
        self,
        theta: ArrayLike,
        voltage: ArrayLike,
        state: State | None = None,
        unrest: FloatArray | None = None,
    ) -> tuple[FloatArray, State]:
        """Displacement along the next piece of a record, and the state at its end.

        Shapes and units as in :meth:`displacement`. Without a ``state`` the record starts here:
        h is θ's initial one and the dynamics are at rest at the first drive, or ``unrest``
        (models, unknowns) away from there, um, as in :class:`~bwbayes.model.linear.Recursion`;
        (models, 0) stands for rest.
        """
        models = np.atleast_2d(np.asarray(theta, dtype=np.float64))
        if models.ndim != 2 or models.shape[1] != len(self.parameters):
            raise InputError(
                f"theta: has shape {models.shape}; its columns are {', '.join(self.parameters)}"
            )
        path = np.asarray(voltage, dtype=np.float64)
        if path.ndim != 1 or path.size == 0:
            raise InputError(f"voltage: has shape {path.shape}; give a non-empty row of samples")
        column = dict(zip(self.parameters, models.T, strict=True))
        self._check_domain(column)
        recursion = self.recursion(column)
        h = self._hysteresis(column, path, state)
        drive = column["d"][:, np.newaxis] * path
        drive -= h
        rest = drive[:, 0].copy() if state is None else state.rest
        memory = recursion.at_rest() if state is None else state.filter.copy()
        if state is None and unrest is not None and unrest.size:
            memory += np.einsum("mu,mut->mt", unrest, recursion.free)
        # The recursion sees the drive's distance from rest, so that it starts at zero exactly.
        drive -= rest[:, np.newaxis]
        result = recursion.run(drive, memory)
        result += (rest + column["offset"])[:, np.newaxis]
        return result, State(float(path[-1]), h[:, -1].copy(), rest, memory)

    def _hysteresis(
        self, column: dict[str, FloatArray], path: FloatArray, state: State | None
    ) -> FloatArray:
        shape = {name: column[name] for name in ("alpha", "beta", "gamma", "exponent")}
        if state is None:
            return hysteresis(path, **shape, initial=column["initial"])
        joined = np.concatenate([[state.voltage], path])
        return hysteresis(joined, **shape, initial=state.hysteretic)[:, 1:]

    def _check_domain(self, column: dict[str, FloatArray]) -> None:
        """Refuse what :func:`hysteresis` does not see."""
        for name in ("d", *self.dynamics_parameters, "offset"):
            values = column[name]
            allowed, demand = np.isfinite(values), "must be finite"
            if name in ("mass", "stiffness"):
                allowed, demand = allowed & (values > 0), "must be positive and finite"
            elif name in ("lag", "damping"):
                allowed, demand = allowed & (values >= 0), "must be finite and not negative"
            if not allowed.all():
                row = int(np.argmin(allowed))
                raise InputError(f"{name}: {values[row]:.6g} in model {row}; {demand}")

    def recursion(self, column: Mapping[str, FloatArray]) -> Recursion:
        """Return the dynamics' recursion of models given by the columns (models,) of θ."""
        if self.dynamics == "second-order":
            return second_order(
                column["mass"], column["damping"], column["stiffness"], self.interval, self.hold
            )
        if self.dynamics == "lag":
            return first_order_lag(column["lag"], self.interval, self.hold)
        return no_dynamics(column["d"].size, self.hold)

    def at_rest(self, theta: FloatArray, voltage: float) -> FloatArray:
        """Return θ (models, parameters) whose initial h is the one at a first ``voltage`` (V).

        The initial h of ``theta`` is taken for the one at zero volts, before the record: from there
        the voltage went straight to the record's first.
        """
        column = dict(zip(self.parameters, theta.T, strict=False))
        shape = {name: column[name] for name in ("alpha", "beta", "gamma", "exponent", "initial")}
        started = theta.copy()
        started[:, self.parameters.index("initial")] = hysteresis([0.0, voltage], **shape)[:, -1]
        return started

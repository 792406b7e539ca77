"""The likelihood of one record: forward model and noise, and what is unknown of its start.

A record that starts in the middle of a drive finds the dynamics in motion: the displacement is not
where the drive would hold it. How far off it is, and how fast it moves, adds a free response that
dies out with the dynamics' own times. It enters the displacement linearly, and so does an offset
of the record's own. Given the other parameters all of these are jointly normal, so a
:class:`Likelihood` integrates them out exactly, and tells where they lie.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.engine import Engine
from bwbayes.inference.noise import Noise
from bwbayes.inference.parameter_table import ParameterTable
from bwbayes.inference.readings import Readings
from bwbayes.inference.state_space import LOG_TWO_PI
from bwbayes.model.actuator import Actuator
from bwbayes.shown import brief

__all__ = ["Likelihood", "LinearStart", "Moments", "Score", "batches"]

# Models simulated together: enough to share the loop over turns, few enough for the memory.
BATCH = 64
ELEMENTS = 1 << 23
CACHED = 1 << 16

# Beside numbers as large as this a one is next to lost to rounding.
LOST = 1e12

# Part of a sum of squares that rounding may take away.
ROUNDING = 1e-15

# What is below exp(-50) of its size adds nothing.
FORGOTTEN = 50.0


def batches(models: int, samples: int, elements: int = ELEMENTS) -> Iterator[slice]:
    """Cut a number of models into batches of so many elements, by default what memory holds."""
    size = min(max(elements // samples, 1), BATCH)
    return (slice(i, min(i + size, models)) for i in range(0, models, size))


class Moments(NamedTuple):
    """What the density needs of whitened series: the residual, then the unknowns' responses.

    ``products`` (models, 1 + unknowns, 1 + unknowns) are Σ zᵢ zⱼ, ``log_determinant`` (models,) is
    that of the noise's covariance.
    """

    products: FloatArray
    log_determinant: FloatArray


class LinearStart(NamedTuple):
    """The normal posterior of a record's unknown start, given all other parameters.

    ``log_density`` (models,) of the readings, the start integrated out; ``squares`` (models,), the
    squared distance of the readings from what is expected, which has a χ² distribution if the
    model is right; ``mean`` (models, unknowns) and ``covariance`` (models, unknowns, unknowns), um
    and um².
    """

    log_density: FloatArray
    squares: FloatArray
    mean: FloatArray
    covariance: FloatArray


class Score(NamedTuple):
    """What shapes in the readings would explain, beside an unknown start.

    ``pull`` u (models, shapes) is the log density's slope in their sizes, where these are zero, and
    ``information`` I (models, shapes, shapes) its bend; ``log_density`` (models,) is that without
    them, nats.
    """

    pull: FloatArray
    information: FloatArray
    log_density: FloatArray

    @property
    def together(self) -> FloatArray:
        """uᵀ I⁻¹ u (models,): χ² with a degree of freedom a shape, if the model is right."""
        pull = self.pull[:, :, np.newaxis]
        squares: FloatArray = np.sum(pull * np.linalg.solve(self.information, pull), axis=(1, 2))
        return squares

    @property
    def sizes(self) -> FloatArray:
        """The best size of each shape, if it is the only one, (models, shapes)."""
        sizes: FloatArray = self.pull / np.einsum("mii->mi", self.information)
        return sizes

    @property
    def nats(self) -> FloatArray:
        """What each shape alone adds to the log density at its best size, (models, shapes)."""
        nats: FloatArray = self.pull * self.sizes / 2
        return nats


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of one record.

    The readings are r = x(θ) + Σ ξᵢ fᵢ + noise, with independent ξᵢ ~ N(0, σᵢ²): fᵢ are the free
    responses of the dynamics, σᵢ = gain times half the voltage's range; the record's own offset, if
    it has one, comes first, with f = 1.

    Parameters
    ----------
    voltage
        (samples,), V, from the record's first sample on.
    readings
        What was read of the displacement, and when.
    actuator, noise
        The model; θ has the actuator's parameters, then the noise's. ``actuator.interval`` is that
        of the samples.
    engine
        What computes it; see :mod:`bwbayes.inference.engine`.
    from_rest
        The actuator is demagnetized and at rest when the record starts: nothing is unknown, and
        the initial state of θ is the one at zero volts before.
    half_range
        Half the range of the voltages that the actuator may have seen, V.
    offset_sd
        Prior sd of an offset of the record's own beside that of θ, um; zero if it has none.
    """

    __repr__ = brief

    voltage: FloatArray
    readings: Readings
    actuator: Actuator
    noise: Noise
    engine: Engine
    from_rest: bool
    half_range: float
    offset_sd: float = 0.0

    @cached_property
    def table(self) -> ParameterTable:
        """The parameters in the order of θ's columns."""
        return ParameterTable(self.actuator, self.noise)

    @cached_property
    def values(self) -> FloatArray:
        """The readings (samples,), um, at their samples; zero elsewhere."""
        values = np.zeros(self.readings.samples)
        values[self.readings.rows] = self.readings.values
        return values

    @cached_property
    def skipped(self) -> FloatArray:
        """Readings missing just before each sample's (samples,); −1 where there is no reading."""
        skipped = np.full(self.readings.samples, -1.0)
        skipped[self.readings.rows] = self.readings.skipped
        return skipped

    def log_density(self, theta: FloatArray) -> FloatArray:
        """Log density (models,) of the readings at θ (models, parameters)."""
        return self.start(theta).log_density

    def start(self, theta: FloatArray) -> LinearStart:
        """Integrate the unknown start out at θ (models, parameters), and say where it lies.

        With whitened series z₀ of the residual and Z of the responses, P = diag(σ²):

            log p = −½ (|z₀ − Z μ|² + μᵀ P⁻¹ μ + log det V + log det(1 + P Zᵀ Z) + n log 2π),
            μ = C Zᵀ z₀,   C = (P⁻¹ + Zᵀ Z)⁻¹.
        """
        products, log_determinant = self.moments(theta)
        sd = self.start_sd(theta)
        scaled = products[:, 1:, 1:] * sd[:, :, np.newaxis] * sd[:, np.newaxis, :]
        precision = np.eye(sd.shape[1]) + scaled
        pull = sd * products[:, 1:, 0]
        covariance, log_volume = _inverse(precision)
        mean = np.einsum("mij,mj->mi", covariance, pull)
        squares = products[:, 0, 0] - np.sum(mean * pull, axis=1)
        # Less cannot be told of a difference: where noise is next to none and an unknown without
        # bounds, what rounding left was a place more probable than any that is possible.
        size = np.abs(pull)
        terms = np.einsum("mi,mij,mj->m", size, np.abs(covariance), size)
        squares = np.maximum(squares, ROUNDING * (products[:, 0, 0] + terms))
        logs = log_determinant + log_volume
        density = -0.5 * (squares + logs + self.readings.rows.size * LOG_TWO_PI)
        covariance *= sd[:, :, np.newaxis] * sd[:, np.newaxis, :]
        return LinearStart(density, squares, sd * mean, covariance)

    def score(
        self, theta: FloatArray, shapes: FloatArray, displacement: FloatArray | None = None
    ) -> Score:
        """Say what shapes (shapes, readings) in the readings, um, would explain at θ.

        With the whitened shapes S, and as in :meth:`start`:

            u = Sᵀ (z₀ − Z μ),   I = Sᵀ S − Sᵀ Z C Zᵀ S.

        ``displacement`` (models, readings), um, takes the place of what the actuator does from rest
        at θ, if it is given.
        """
        scores = []
        for batch in batches(len(theta), self.readings.rows.size, CACHED):
            simulated = None if displacement is None else displacement[batch]
            series, log_determinant = self._whitened(theta[batch], shapes, simulated)
            products = np.einsum("mit,mjt->mij", series, series)
            sd = self.start_sd(theta[batch])
            first = 1 + sd.shape[1]
            prior = sd[:, :, np.newaxis] * sd[:, np.newaxis, :]
            precision = np.eye(sd.shape[1]) + prior * products[:, 1:first, 1:first]
            inverse, log_volume = _inverse(precision)
            others = products[:, 1:first]
            # Of all products what the unknowns do not explain.
            free = products - np.einsum("mui,muv,mvj->mij", others, inverse * prior, others)
            logs = log_determinant + log_volume + self.readings.rows.size * LOG_TWO_PI
            density = -0.5 * (free[:, 0, 0] + logs)
            scores.append(Score(free[:, first:, 0], free[:, first:, first:], density))
        return Score(*(np.concatenate(values) for values in zip(*scores, strict=True)))

    def _whitened(
        self, theta: FloatArray, shapes: FloatArray, displacement: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Whiten residual, unknowns' responses and shapes: (models, series, readings).

        Beside them the log determinant (models,) of the noise's covariance.
        """
        readings = self.readings
        model, noise = self.table.actuator(theta), self.table.noise(theta)
        if displacement is None:
            displacement = self._simulated(model)[:, readings.where]
        responses = self._responses(model, noise)
        audible = responses.shape[2]
        series = np.zeros((len(theta), 1 + responses.shape[1] + len(shapes), readings.rows.size))
        series[:, 0] = readings.values - displacement
        series[:, 1 : 1 + responses.shape[1], :audible] = responses
        series[:, 1 + responses.shape[1] :] = shapes
        return self.whiten(noise, series)

    def whiten(self, noise: FloatArray, series: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whiten series (models, series, readings), um, as :meth:`Noise.whiten` does.

        ``noise`` is (models, parameters of the noise).
        """
        if self.engine == "numba" and self.noise.states:
            from bwbayes.inference import compiled  # noqa: PLC0415  # as in `moments`

            return compiled.whiten(self.spaced, noise, series, self.readings.skipped)
        return self.spaced.whiten(noise, series, self.readings.skipped)

    def start_sd(self, theta: FloatArray) -> FloatArray:
        """Prior sd (models, unknowns) of the unknown start, um."""
        unknowns = 0 if self.from_rest else self.actuator.unknowns
        gain = self.actuator.typical_slope(self.table.actuator(theta), self.voltage)
        sd = np.repeat((gain * self.half_range)[:, np.newaxis], unknowns, axis=1)
        if self.offset_sd:
            sd = np.concatenate([np.full((len(sd), 1), self.offset_sd), sd], axis=1)
        return sd

    @property
    def spaced(self) -> Noise:
        """The noise for the interval between readings."""
        return self.noise.at(self.actuator.interval * self.readings.stride)

    @property
    def unknown(self) -> bool:
        """Tell whether anything is unknown of the start."""
        return bool(self.offset_sd) or not (self.from_rest or self.actuator.unknowns == 0)

    def simulate(
        self, model: FloatArray, voltage: FloatArray, unrest: FloatArray | None = None
    ) -> FloatArray:
        """Displacement (models, samples), um, along a voltage (samples,), V.

        ``model`` is (models, parameters of the actuator); ``unrest`` (models, unknowns), um, is how
        far dynamics and creep are from rest at the first sample.
        """
        if self.engine == "numba":
            # Here, because it is slow to load.
            from bwbayes.inference.compiled.walk import walk  # noqa: PLC0415

            state = walk(self.actuator, model, voltage, unrest, from_rest=self.from_rest)
            if state is not None:
                return state.to(voltage.size)
        return self.actuator.advance(model, voltage, None, unrest, from_rest=self.from_rest)[0]

    def _simulated(self, model: FloatArray) -> FloatArray:
        """Displacement (models, samples), um, up to the last reading, the dynamics at rest."""
        voltage = self.voltage[: self.readings.samples]
        return self.actuator.displacement(model, voltage, from_rest=self.from_rest)

    def moments(self, theta: FloatArray) -> Moments:
        """Whiten the residual and the unknowns' responses at θ (models, parameters)."""
        if self.engine == "numba":
            # Here, because numba may not be installed, and takes half a second to load.
            from bwbayes.inference import compiled  # noqa: PLC0415

            return Moments(
                *compiled.moments(
                    theta,
                    self.voltage[: self.readings.samples],
                    self.values,
                    self.skipped,
                    self.actuator,
                    self.spaced,
                    int(self.offset_sd > 0),
                    0 if self.from_rest else self.actuator.unknowns,
                    from_rest=self.from_rest,
                )
            )
        pieces = batches(len(theta), self.readings.samples)
        parts = [self._moments(theta[batch]) for batch in pieces]
        return Moments(*(np.concatenate(values) for values in zip(*parts, strict=True)))

    def _moments(self, theta: FloatArray) -> Moments:
        """Do it with NumPy for one batch of models."""
        readings, spaced = self.readings, self.spaced
        model, noise = self.table.actuator(theta), self.table.noise(theta)
        residual = readings.values - self._simulated(model)[:, readings.where]
        responses = self._responses(model, noise)
        audible = responses.shape[2]
        white, log_determinant = spaced.whiten(noise, residual[:, np.newaxis], readings.skipped)
        pulls, _ = spaced.whiten(noise, responses, readings.skipped[:audible])
        return Moments(
            _products([white[:, 0], *np.moveaxis(pulls, 1, 0)], audible), log_determinant
        )

    def _responses(self, model: FloatArray, noise: FloatArray) -> FloatArray:
        """Unknowns' responses (models, unknowns, readings), as long as the noise hears of them.

        An offset stays; a free response dies out with the dynamics, and the noise's filter forgets
        it.
        """
        rows = self.readings.rows
        sections = self.actuator.sections(self.actuator.columns(model))
        unknowns = 0 if self.from_rest else sections.unknowns
        if self.offset_sd:
            audible = rows.size
        elif unknowns:
            nothing = np.exp(-FORGOTTEN)
            slowest = np.log(max(float(np.max(sections.remembered)), nothing))
            decay = np.log(max(float(np.max(self.spaced.decay(noise))), nothing))
            forgotten = FORGOTTEN + rows * slowest < 0
            forgotten &= FORGOTTEN + np.arange(rows.size) * decay < 0
            audible = int(np.argmax(forgotten)) if forgotten[-1] else rows.size
        else:
            audible = 0
        free = sections.free_responses(int(rows[audible - 1]) + 1 if audible and unknowns else 0)
        parts = [
            free[:, :unknowns, rows[:audible]] if unknowns else np.empty((len(model), 0, audible))
        ]
        if self.offset_sd:
            parts.insert(0, np.ones((len(model), 1, audible)))
        return np.concatenate(parts, axis=1)


def _inverse(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Invert 1 + S (models, size, size), S not negative; logarithms of the determinants too."""
    if matrices.shape[1] == 1:
        # Which is most records: the library would take longer over it than over all the readings.
        return 1 / matrices, np.log(matrices[:, 0, 0])
    lost = np.max(matrices, axis=(1, 2), initial=0.0) > LOST
    if not lost.any():
        return np.linalg.inv(matrices), np.linalg.slogdet(matrices)[1]
    # Eigenvalues that are rounding beside the largest are taken for the one that was lost.
    inverse, log_determinant = np.empty_like(matrices), np.empty(len(matrices))
    inverse[~lost], log_determinant[~lost] = _inverse(matrices[~lost])
    values, vectors = np.linalg.eigh(matrices[lost])
    smallest = 4 * matrices.shape[1] * np.finfo(float).eps * values[:, -1:]
    values = np.where(values < np.maximum(smallest, 1.0), 1.0, values)
    inverse[lost] = (vectors / values[:, np.newaxis]) @ np.swapaxes(vectors, 1, 2)
    log_determinant[lost] = np.sum(np.log(values), axis=1)
    return inverse, log_determinant


def _products(series: list[FloatArray], audible: int) -> FloatArray:
    """Σ zᵢ zⱼ (models, series, series); all series but the first (models, readings) are shorter."""
    products = np.empty((len(series[0]), len(series), len(series)))
    for i, first in enumerate(series):
        for j, second in enumerate(series[: i + 1]):
            # Sums, not dot products: a linear algebra library may split those over threads.
            product = np.sum(first**2 if i == j else first * second[:, :audible], axis=1)
            products[:, i, j] = products[:, j, i] = product
    return products

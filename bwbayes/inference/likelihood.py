"""The likelihood of one record: forward model and noise, and what is unknown of its start.

The model is simulated along every voltage sample; only some samples have a reading that counts:
those inside the training windows that are not missing (:class:`Readings`).

A record that starts in the middle of a drive finds the dynamics in motion: the displacement is not
where the drive would hold it. How far off it is, and how fast it moves, adds a free response that
dies out with the dynamics' own times. It enters the displacement linearly, and so does an offset
of the record's own. Given the other parameters all of these are jointly normal, so a
:class:`Likelihood` integrates them out exactly, and tells where they lie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference import Engine, heavy_tails
from bwbayes.inference.defaults import rounding_sd
from bwbayes.inference.heavy_tails import Followed
from bwbayes.inference.parameters import ParameterTable
from bwbayes.inference.state_space import LOG_TWO_PI, Noise
from bwbayes.model.actuator import Actuator
from bwbayes.model.inputs import Inputs, Span, rate
from bwbayes.shown import brief


@dataclass(frozen=True)
class Readings:
    """Readings of a record, in order of time.

    Parameters
    ----------
    rows
        (readings,) the sample of each.
    values
        (readings,), um.
    stride
        Samples from one reading to the next, where none is missing.
    skipped
        (readings,) readings that are missing just before each one: how much farther than ``stride``
        it is from the one before, in strides.
    """

    __repr__ = brief

    rows: IntArray
    values: FloatArray
    stride: int
    skipped: FloatArray

    @classmethod
    def of(cls, displacement: FloatArray, windows: Sequence[slice]) -> Readings:
        """Take the readings in windows (slices) of a displacement (samples,); nan marks a gap.

        Raises
        ------
        InputError
            There is none.
        """
        rows = np.concatenate([np.arange(w.start, w.stop) for w in windows]).astype(np.int64)
        rows = rows[np.isfinite(displacement[rows])]
        if not rows.size:
            raise InputError("record.train: it holds no reading; give another window")
        gaps = np.diff(rows)
        stride = int(gaps.min()) if gaps.size else 1
        skipped = np.concatenate([[0.0], (gaps - stride) / stride])
        return cls(rows, displacement[rows], stride, skipped)

    @cached_property
    def gaps(self) -> tuple[FloatArray, IntArray]:
        """Numbers of missing readings (kinds,), 0 first, and which is before each (readings,)."""
        numbers, which = np.unique(np.append(self.skipped, 0.0), return_inverse=True)
        return numbers, which[:-1]

    @property
    def samples(self) -> int:
        """Samples of the record up to the last reading."""
        return int(self.rows[-1]) + 1

    @property
    def where(self) -> slice | IntArray:
        """The rows as an index: a slice, which copies nothing, if no reading is missing."""
        if self.skipped.any():
            return self.rows
        return slice(int(self.rows[0]), self.samples, self.stride)


def batches(models: int, samples: int, elements: int = 1 << 23) -> Iterator[slice]:
    """Cut a number of models into batches of so many elements, by default what memory holds.

    A batch has 64 at most, or what a megabyte holds: enough to share what is done once for all.
    """
    size = min(max(elements // samples, 1), max(64, (1 << 17) // samples))
    return (slice(i, min(i + size, models)) for i in range(0, models, size))


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
    """The gradient and curvature of shapes in the readings, beside an unknown start.

    ``gradient`` u (models, shapes) is the log density's in their sizes, where these are zero, and
    ``fisher_information`` I (models, shapes, shapes) minus its Hessian; ``log_density`` (models,)
    is that without them, nats.
    """

    gradient: FloatArray
    fisher_information: FloatArray
    log_density: FloatArray

    @property
    def together(self) -> FloatArray:
        """uᵀ I⁻¹ u (models,): χ² with a degree of freedom a shape, if the model is right."""
        gradient = self.gradient[:, :, np.newaxis]
        steps = np.linalg.solve(self.fisher_information, gradient)
        squares: FloatArray = np.sum(gradient * steps, axis=(1, 2))
        return squares


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of one record, from its first sample on.

    The readings are r = x(θ) + Σ ξᵢ fᵢ + noise, with independent ξᵢ ~ N(0, σᵢ²): fᵢ are the free
    responses of the dynamics, σᵢ = gain times half the voltage's range, and of creep so much of it
    as :meth:`Creep.reach` says; the record's own offset, if it has one, comes first, with f = 1.
    Stages behind the dynamics let fᵢ pass as they are.

    Parameters
    ----------
    inputs
        Those of the record.
    displacement
        (samples,), um; nan where a reading is missing.
    training
        Slices of the samples that enter the likelihood, in order of time and apart. One discrepancy
        goes through all of them.
    actuator, noise
        The model, at the record's own sampling interval and hold; θ has the actuator's parameters,
        then the noise's.
    from_rest
        The actuator is demagnetized and at rest when the record starts: nothing is unknown, and
        the initial state of θ is the one at zero volts before.
    name
        Name of the record.
    engine
        Engine; see :mod:`bwbayes.inference`.
    offset_sd
        Prior sd of an offset of the record's own beside that of θ, um; zero if it has none.
    half_range
        Half the range of the voltages that sets the size of the unknown start, V; by default of
        those that the actuator may have seen.

    Raises
    ------
    InputError
        The windows are out of order.
    """

    __repr__ = brief

    inputs: Inputs
    displacement: FloatArray
    training: tuple[slice, ...]
    actuator: Actuator
    noise: Noise
    from_rest: bool = False
    name: str = "record"
    engine: Engine = "numpy"
    offset_sd: float = 0.0
    half_range: float | None = None

    def __post_init__(self) -> None:
        edges = [edge for window in self.training for edge in (window.start, window.stop)]
        if edges != sorted(edges):
            raise InputError("training: windows must be in order of time and must not overlap")

    def by(self, engine: Engine) -> Likelihood:
        """Return the likelihood by an engine, its actuator within the range of the voltage."""
        return replace(self, actuator=self.actuator.within(self.voltage), engine=engine)

    @cached_property
    def table(self) -> ParameterTable:
        """The parameters in the order of θ's columns."""
        return ParameterTable(self.actuator, self.noise)

    @property
    def voltage(self) -> FloatArray:
        """The voltage (samples,), V."""
        return self.inputs.voltage

    @cached_property
    def readings(self) -> Readings:
        """The readings that enter the likelihood."""
        return Readings.of(self.displacement, self.training)

    @property
    def span(self) -> Span:
        """The voltages that the actuator may have seen, V."""
        return self.actuator.range_of(self.voltage)

    @property
    def extent(self) -> float:
        """Range of the readings that enter the likelihood, um."""
        return float(np.ptp(self.readings.values))

    def is_followed(self, displacement: FloatArray) -> bool:
        """Tell whether a displacement (readings,), um, misses no more than rounding would.

        Where readings show no noise nothing else is left to learn from what it misses.
        """
        values = self.readings.values
        return float(np.std(values - displacement)) < rounding_sd(values)

    @cached_property
    def inputs_read(self) -> Inputs:
        """The inputs up to the last reading."""
        return self.inputs[: self.readings.samples]

    @cached_property
    def values(self) -> FloatArray:
        """The readings (samples,), um, at their samples; zero elsewhere."""
        values = np.zeros(self.readings.samples)
        values[self.readings.rows] = self.readings.values
        return values

    @cached_property
    def gaps(self) -> IntArray:
        """Which of the readings' gaps is just before each sample's (samples,); −1 without one."""
        gaps = np.full(self.readings.samples, -1)
        gaps[self.readings.rows] = self.readings.gaps[1]
        return gaps

    def log_density(self, theta: FloatArray, displacement: FloatArray | None = None) -> FloatArray:
        """Log density (models,) of the readings at θ (models, parameters).

        ``displacement`` is as in :meth:`score`.
        """
        if self.noise.tailed:
            return self._follow(theta, displacement).log_density
        return self.start(theta, displacement).log_density

    def start(self, theta: FloatArray, displacement: FloatArray | None = None) -> LinearStart:
        """Integrate the unknown start out at θ (models, parameters), and say where it lies.

        With whitened series z₀ of the residual and Z of the responses, P = diag(σ²):

            log p = −½ (|z₀ − Z μ|² + μᵀ P⁻¹ μ + log det V + log det(1 + P Zᵀ Z) + n log 2π),
            μ = C Zᵀ z₀,   C = (P⁻¹ + Zᵀ Z)⁻¹.

        Where the sensor's noise has heavy tails, by the filter of
        :mod:`~bwbayes.inference.heavy_tails`, to which the start is a state. ``displacement`` is
        as in :meth:`score`.
        """
        if self.noise.tailed:
            followed, states = self._follow(theta, displacement), self.noise.states
            scores = heavy_tails.normal_scores(self.spaced, self.table.noise(theta), followed)
            return LinearStart(
                followed.log_density,
                np.sum(scores**2, axis=1),
                followed.mean[:, states:],
                followed.covariance[:, states:, states:],
            )
        if self.engine == "numpy" or self.noise.paced:
            nothing = np.empty((0, self.readings.rows.size))
            products = self.products_of_series(theta, nothing, displacement)
        else:
            # Here, because numba may not be installed, and takes half a second to load.
            from bwbayes.inference import compiled  # noqa: PLC0415

            products = compiled.products(self, theta, displacement)
        return self._integrate_unknowns(theta, *products)

    def score(
        self, theta: FloatArray, shapes: FloatArray, displacement: FloatArray | None = None
    ) -> Score:
        """Say what shapes (shapes, readings) in the readings, um, would explain at θ.

        Each model may have shapes of its own, (models, shapes, readings). With the whitened shapes
        S, and as in :meth:`start`:

            u = Sᵀ (z₀ − Z μ),   I = Sᵀ S − Sᵀ Z C Zᵀ S.

        Where the sensor's noise has heavy tails they are those of normal noise of the variances
        that it has in effect.

        ``displacement`` (models, readings), um, takes the place of what the actuator does from rest
        at θ, if it is given. If it has fewer rows than there are models, they take its rows in
        turn.
        """
        products, log_determinant = self.products_of_series(theta, shapes, displacement)
        start, end = self._integrate_unknowns(theta, products, log_determinant), 1 + self.unknowns
        series = [0, *range(end, products.shape[1])]
        across = products[:, 1:end][:, :, series]
        explained = np.einsum("mui,muv,mvj->mij", across, start.covariance, across)
        unexplained = products[:, series][:, :, series] - explained
        if self.noise.tailed:
            density = self._follow(theta, displacement).log_density
            return Score(unexplained[:, 1:, 0], unexplained[:, 1:, 1:], density)
        return Score(unexplained[:, 1:, 0], unexplained[:, 1:, 1:], start.log_density)

    def _integrate_unknowns(
        self, theta: FloatArray, products: FloatArray, log_determinant: FloatArray
    ) -> LinearStart:
        """Integrate the unknowns out of products (models, series, series) of whitened series.

        These are the residual, the unknowns' responses and any others.
        """
        sd = self.start_sd(theta)
        end = 1 + sd.shape[1]
        prior = sd[:, :, np.newaxis] * sd[:, np.newaxis, :]
        pull = sd * products[:, 1:end, 0]
        matrices = np.eye(end - 1) + prior * products[:, 1:end, 1:end]
        mean, covariance, log_volume = _solve(matrices, pull)
        squares = products[:, 0, 0] - np.sum(mean * pull, axis=1)
        # Less cannot be told of a difference: where noise is next to none and an unknown without
        # bounds, what rounding left was a place more probable than any that is possible.
        size = np.abs(pull)
        terms = np.einsum("mi,mij,mj->m", size, np.abs(covariance), size)
        squares = np.maximum(squares, 1e-15 * (products[:, 0, 0] + terms))
        logs = log_determinant + log_volume + self.readings.rows.size * LOG_TWO_PI
        return LinearStart(-0.5 * (squares + logs), squares, sd * mean, prior * covariance)

    def start_sd(self, theta: FloatArray) -> FloatArray:
        """Prior sd (models, unknowns) of the unknown start, um."""
        column = self.actuator.columns(self.table.actuator(theta))
        gain = self.actuator.hysteresis.typical_slope(column, self.span)
        half_range = self.span.half if self.half_range is None else self.half_range
        sd = np.repeat((gain * half_range)[:, np.newaxis], self.unknowns, axis=1)
        if (creep := self.actuator.creep) is not None and not self.from_rest:
            sd[:, -len(creep.times) :] *= creep.reach(column)
        if self.offset_sd:
            sd[:, 0] = self.offset_sd
        return sd

    @cached_property
    def speed(self) -> FloatArray:
        """Speed of the voltage at the readings (readings,), V/s."""
        return np.abs(rate(self.voltage, self.actuator.interval))[self.readings.rows]

    def sensor(self, noise: FloatArray) -> FloatArray | None:
        """Return variances (models, readings), um², of sensor noise that grows with the speed."""
        return self.noise.sensor_variance(noise, self.speed) if self.noise.paced else None

    @property
    def spaced(self) -> Noise:
        """The noise for the interval between readings."""
        return self.noise.at(self.actuator.interval * self.readings.stride)

    @cached_property
    def unknowns(self) -> int:
        """How many numbers are unknown of the start: the offset, if any, then the dynamics'."""
        return int(self.offset_sd > 0) + (0 if self.from_rest else self.actuator.unknowns)

    def simulate(
        self, model: FloatArray, inputs: Inputs, initial_transient: FloatArray | None = None
    ) -> FloatArray:
        """Displacement (models, samples), um, along inputs.

        ``model`` is (models, parameters of the actuator); ``initial_transient`` (models, unknowns),
        um, is how far dynamics and creep are from rest at the first sample.
        """
        return self.walk(model, inputs, initial_transient)(inputs.samples)

    def walk(
        self, model: FloatArray, inputs: Inputs, initial_transient: FloatArray | None = None
    ) -> Callable[[int], FloatArray]:
        """Put models to the inputs' first sample; what is returned walks them on to a sample.

        Called with growing numbers of samples, it returns the displacement (models, samples), um,
        from where they are. The others are as in :meth:`simulate`.
        """
        if self.engine == "numba":
            # Here, because it is slow to load.
            from bwbayes.inference.compiled.walk import walk  # noqa: PLC0415

            return walk(self.actuator, model, inputs, initial_transient, from_rest=self.from_rest)
        state, now = None, 0

        def onwards(last: int) -> FloatArray:
            nonlocal state, now
            next_inputs, now = inputs[now:last], last
            moved, state = self.actuator.advance(
                model, next_inputs, state, initial_transient, from_rest=self.from_rest
            )
            return moved

        return onwards

    def products_of_series(
        self, theta: FloatArray, shapes: FloatArray, displacement: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return Σ zᵢ zⱼ (models, series, series) of whitened residual, responses and shapes.

        Beside them the log determinant (models,) of the noise's covariance. Shapes are (shapes,
        readings); ``displacement`` is as in :meth:`score`.
        """
        results = []
        for rows, noise, series in self._series(theta, shapes, displacement):
            sensor = None
            if self.noise.tailed:
                fixed_part = series[:, : 1 + self.unknowns]
                sensor = self.follow(noise, fixed_part, self.start_sd(theta[rows])).sensor
            white, log_determinant = self.whiten(noise, series, sensor)
            # Sums, not dot products: a linear algebra library may split those over threads.
            results.append((np.einsum("mit,mjt->mij", white, white), log_determinant))
        products, determinants = zip(*results, strict=True)
        return np.concatenate(products), np.concatenate(determinants)

    def _series(
        self, theta: FloatArray, shapes: FloatArray, displacement: FloatArray | None
    ) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Yield rows of θ, their noise's parameters, and residual, responses and shapes, um."""
        readings, n_series = self.readings, 1 + self.unknowns + shapes.shape[-2]
        # Shapes are many: NumPy is to have a model's series in the cache. Compiled code takes many
        # models in the time of one.
        elements = 1 << 16 if shapes.size and self.engine == "numpy" else 1 << 23
        shapes_of_models = np.broadcast_to(shapes, (len(theta), *shapes.shape[-2:]))
        if displacement is not None:
            displacement = displacement[np.arange(len(theta)) % len(displacement)]
        for batch in batches(len(theta), readings.samples * n_series, elements):
            model, noise = self.table.actuator(theta[batch]), self.table.noise(theta[batch])
            if displacement is None:
                moved = self.simulate(model, self.inputs_read)[:, readings.where]
            else:
                moved = displacement[batch]
            residual = (readings.values - moved)[:, np.newaxis]
            offsets = np.ones((len(model), int(self.offset_sd > 0), readings.rows.size))
            parts = [residual, offsets]
            if not self.from_rest:
                sections = self.actuator.sections(self.actuator.columns(model))
                parts.append(sections.free_responses(readings.samples)[..., readings.where])
            parts.append(shapes_of_models[batch])
            yield batch, noise, np.concatenate(parts, axis=1)

    def whiten(
        self, noise: FloatArray, series: FloatArray, sensor: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Whiten series (models, series, readings), um, as :meth:`Noise.whiten` does.

        ``noise`` is (models, parameters of the noise); ``sensor`` as in :meth:`Noise.filter`.
        """
        if self.noise.tailed and sensor is None:
            sensor = self.follow(noise, series[:, :1], np.empty((len(noise), 0))).sensor
        if sensor is None:
            sensor = self.sensor(noise)
        if self.engine == "numba" and self.noise.states:
            from bwbayes.inference import compiled  # noqa: PLC0415  # as for the products

            return compiled.whiten(self.spaced, noise, series, self.readings.gaps, sensor)
        if sensor is not None:
            filtered = self.spaced.filter(noise, series, self.readings.skipped, sensor)
            return filtered.white, filtered.log_determinant
        return self.spaced.whiten(noise, series, self.readings.skipped)

    def innovations(self, noise: FloatArray, residual: FloatArray) -> FloatArray:
        """Turn residuals (models, readings), um, into innovations, standard normal if all is right.

        ``noise`` is (models, parameters of the noise).
        """
        series = residual[:, np.newaxis]
        if self.noise.tailed:
            followed = self.follow(noise, series, np.empty((len(noise), 0)))
            return heavy_tails.normal_scores(self.spaced, noise, followed)
        return self.whiten(noise, series)[0][:, 0]

    def follow(self, noise: FloatArray, series: FloatArray, start_sd: FloatArray) -> Followed:
        """Filter series as :func:`bwbayes.inference.heavy_tails.follow` does."""
        along = heavy_tails.run
        if self.engine == "numba":
            from bwbayes.inference.compiled import whitening  # noqa: PLC0415  # as for the products

            along = whitening.run
        skipped = self.readings.skipped
        return heavy_tails.follow(self.spaced, noise, series, start_sd, skipped, along)

    def _follow(self, theta: FloatArray, displacement: FloatArray | None = None) -> Followed:
        """Filter the readings at θ (models, parameters); ``displacement`` as in :meth:`score`."""
        nothing = np.empty((0, self.readings.rows.size))
        followed = [
            self.follow(noise, series, self.start_sd(theta[rows]))
            for rows, noise, series in self._series(theta, nothing, displacement)
        ]
        return Followed(*map(np.concatenate, zip(*followed, strict=True)))


def _solve(matrices: FloatArray, pull: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solve (1 + S) x = pull (models, size), S (models, size, size) not negative.

    Returns x, the inverses of 1 + S, and the logarithms of the determinants.
    """
    if matrices.shape[1] == 1:
        # Which is most records: the library would take longer over it than over all the readings.
        return pull / matrices[:, 0], 1 / matrices, np.log(matrices[:, 0, 0])
    # Beside numbers as large as this the one is next to lost to rounding.
    lost = np.max(matrices, axis=(1, 2), initial=0.0) > 1e12
    if not lost.any():
        inverse = np.linalg.inv(matrices)
        solution = _times(inverse, pull)
        # Terms of the inverse times pull may cancel to a millionth, and then its rounding is large:
        # the solution is refined by what it leaves of the equations.
        solution += _times(inverse, pull - _times(matrices, solution))
        return solution, inverse, np.linalg.slogdet(matrices)[1]
    # Eigenvalues that are rounding beside the largest are taken for the one that was lost.
    solution, inverse = np.empty_like(pull), np.empty_like(matrices)
    log_determinant = np.empty(len(matrices))
    solution[~lost], inverse[~lost], log_determinant[~lost] = _solve(matrices[~lost], pull[~lost])
    values, vectors = np.linalg.eigh(matrices[lost])
    smallest = 4 * matrices.shape[1] * np.finfo(float).eps * values[:, -1:]
    values = np.where(values < np.maximum(smallest, 1.0), 1.0, values)
    inverse[lost] = (vectors / values[:, np.newaxis]) @ np.swapaxes(vectors, 1, 2)
    solution[lost] = _times(inverse[lost], pull[lost])
    log_determinant[lost] = np.sum(np.log(values), axis=1)
    return solution, inverse, log_determinant


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return each matrix (models, size, size) times its vector (models, size)."""
    product: FloatArray = np.einsum("mij,mj->mi", matrices, vectors)
    return product

"""The posterior: forward model, noise and prior put together around one record, or several.

A :class:`Posterior` gives the log density of a batch of models in the unconstrained coordinates
in which everything downstream works: the point fit, the sampler, the diagnostics. Its likelihood is
the sum over those of its records (:class:`Likelihood`), each with its own voltage, windows and
start. Each is simulated from its first sample; only readings in the training windows enter. One
record is a joint fit of one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from bwbayes.arrays import FloatArray, IntArray
from bwbayes.errors import InputError
from bwbayes.inference import Engine
from bwbayes.inference.likelihood import Likelihood, Score, batches
from bwbayes.inference.parameters import JointPrior, ParameterTable
from bwbayes.shown import brief

# Normal scores of the priors' models, 97% of them, whose readings are fitted.
FARTHEST_FOLLOWED = 2.2


@dataclass(frozen=True)
class Posterior:
    """The posterior of an actuator's parameters, given records of it.

    Parameters
    ----------
    datasets
        The likelihoods of the records; at least one.
    prior
        Its parameters are those of :attr:`table`, in that order.
    engine
        Engine of the likelihood: ``"numpy"``, or ``"numba"``, which is compiled.
    joint
        The parameters of several records; may be left out of one.

    Raises
    ------
    InputError
        The prior is another model's.
    """

    __repr__ = brief

    datasets: tuple[Likelihood, ...]
    prior: JointPrior
    engine: Engine = "numpy"
    joint: ParameterTable | None = None

    def __post_init__(self) -> None:
        expected = self.table.names
        if self.prior.names != expected:
            raise InputError(f"prior: its parameters must be {', '.join(expected)}, in this order")

    @cached_property
    def table(self) -> ParameterTable:
        """The parameters in the order of θ's columns."""
        names = tuple(dataset.name for dataset in self.datasets)
        return self.joint or replace(self.datasets[0].table, records=names)

    @property
    def single_record(self) -> Likelihood:
        """The record, of a posterior of one; see :meth:`for_record` for one of several.

        Raises
        ------
        InputError
            There are several.
        """
        if len(self.datasets) > 1:
            names = ", ".join(dataset.name for dataset in self.datasets)
            raise InputError(f"record: several were fitted ({names}), and this is for a fit of one")
        return self.datasets[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of the coordinates."""
        return self.prior.free_names

    def log_density(self, coordinates: FloatArray) -> FloatArray:
        """Log density (models,) at coordinates (models, free): likelihood and prior.

        −∞ where the prior is zero. A likelihood that is not a number, or infinite, is not evidence
        for a model: there the density is −∞ too.
        """
        free, result = self.prior.constrain(coordinates)
        possible = np.isfinite(result)
        if possible.any():
            result[possible] += self.log_likelihood(self.prior.theta(free[possible]))
        return np.where(np.isfinite(result), result, -np.inf)

    def log_likelihood(
        self, theta: FloatArray, displacement: FloatArray | None = None
    ) -> FloatArray:
        """Log likelihood (models,) at θ (models, parameters): the sum over the records.

        ``displacement`` (models, readings), um, takes the place of what models do from rest, if it
        is known; readings are those of all records, one after the other. If ``displacement``
        has fewer rows than there are models, models take its rows in turn.
        """
        total = np.zeros(len(theta))
        for likelihood, columns in zip(self.likelihoods, self._columns, strict=True):
            moved = None if displacement is None else displacement[:, columns]
            total += likelihood.log_density(self.table.of(theta, likelihood.name), moved)
        return total

    @cached_property
    def likelihoods(self) -> tuple[Likelihood, ...]:
        """The likelihood of each record, by the posterior's engine."""
        return tuple(dataset.by(self.engine) for dataset in self.datasets)

    @property
    def likelihood(self) -> Likelihood:
        """The likelihood, of a posterior of one record."""
        (only,) = self.likelihoods
        return only

    def simulate(
        self, theta: FloatArray, rows: IntArray | slice = slice(None), record: str | None = None
    ) -> FloatArray:
        """Displacement (models, rows), um, at samples up to the last training sample of a record.

        The name of the record may be left out if there is one alone. Where the start of the
        dynamics is unknown, it is the most probable one.
        """
        return np.concatenate(list(self.simulations(theta, rows, record)))

    def simulations(
        self, theta: FloatArray, rows: IntArray | slice = slice(None), record: str | None = None
    ) -> Iterator[FloatArray]:
        """Yield the rows of :meth:`simulate` a few at a time, where all would not fit into memory.

        Each is (some models, rows), in the order of θ.
        """
        name = self.single_record.name if record is None else record
        likelihood = next(each for each in self.likelihoods if each.name == name)
        theta = self.table.of(theta, name)
        model = likelihood.table.actuator(theta)
        initial_transient = likelihood.start(theta).mean if likelihood.unknowns else None
        inputs = likelihood.inputs[: likelihood.training[-1].stop]

        for batch in batches(len(theta), inputs.samples):
            moving = None if initial_transient is None else initial_transient[batch]
            yield likelihood.simulate(model[batch], inputs, moving)[:, rows]

    @cached_property
    def _columns(self) -> tuple[slice, ...]:
        """Which columns of readings are each record's, where those of all come one by one."""
        ends = np.cumsum([0, *(dataset.readings.rows.size for dataset in self.datasets)]).tolist()
        return tuple(slice(*pair) for pair in pairwise(ends))

    def displacement(self, theta: FloatArray, log_prior: FloatArray) -> FloatArray:
        """Displacement (models, readings), um, from rest, at θ (models, parameters).

        Readings are those of all records, one after the other; nan where the log prior (models,)
        is −∞.
        """
        possible = np.flatnonzero(np.isfinite(log_prior))
        result = np.full((len(theta), self._columns[-1].stop), np.nan)
        for likelihood, columns in zip(self.likelihoods, self._columns, strict=True):
            readings = likelihood.readings
            model = likelihood.table.actuator(self.table.of(theta, likelihood.name))
            for batch in batches(possible.size, readings.samples):
                models = possible[batch]
                moved = likelihood.simulate(model[models], likelihood.inputs_read)
                result[models, columns] = moved[:, readings.where]
        return result

    def score(self, theta: FloatArray, shapes: FloatArray, displacement: FloatArray) -> Score:
        """Return the sum of :meth:`Likelihood.score` over the records.

        ``shapes`` (models, shapes, readings) and ``displacement`` (models, readings), um, are of
        the readings of all records, one after the other.
        """
        scores = [
            likelihood.score(
                self.table.of(theta, likelihood.name),
                shapes[..., columns],
                displacement[:, columns],
            )
            for likelihood, columns in zip(self.likelihoods, self._columns, strict=True)
        ]
        return Score(*(np.sum(parts, axis=0) for parts in zip(*scores, strict=True)))

    def noise_of_new(self, theta: FloatArray) -> FloatArray:
        """Return the noise's parameters (models, its own) for readings that were not fitted.

        Only for a posterior of one record; ``theta`` (models, parameters) are draws from it.
        """
        readings = self.single_record.readings

        def missed() -> float:
            total = np.zeros(readings.rows.size)
            for simulated in self.simulations(theta, readings.rows):
                total += simulated.sum(axis=0)
            return float(np.mean((readings.values - total / len(theta)) ** 2))

        return self.single_record.noise.for_new_readings(
            self.single_record.table.noise(theta), missed
        )

    def altered(self, *, voltage: FloatArray | None = None, **fields: Any) -> Posterior:
        """Return a posterior of one record with another voltage, or other fields of its dataset.

        Covariates are unknown of another voltage.
        """
        if voltage is not None:
            fields["inputs"] = replace(self.single_record.inputs, voltage=voltage, covariates={})
        return replace(self, datasets=(replace(self.single_record, **fields),))

    def known(self) -> Posterior:
        """Return the posterior of those readings that 97% of the prior's models can follow."""
        scores = FARTHEST_FOLLOWED * np.array([-1.0, 1.0])
        ends = [p.distribution.form.value(scores) for p in self.prior.free]
        theta = self.prior.theta(np.stack(ends, axis=1))
        displacements = {}
        for dataset in self.datasets:
            model = dataset.table.actuator(self.table.of(theta, dataset.name))
            displacements[dataset.name] = dataset.actuator.known(
                model, dataset.displacement, from_rest=dataset.from_rest
            )
        return self.with_readings(displacements)

    def with_training(self, windows: Mapping[str, tuple[slice, ...]]) -> Posterior:
        """Return the posterior of other training windows of the same records, by name."""
        datasets = (replace(dataset, training=windows[dataset.name]) for dataset in self.datasets)
        return replace(self, datasets=tuple(datasets))

    def with_readings(self, displacements: Mapping[str, FloatArray]) -> Posterior:
        """Return the posterior of other readings (samples,) of the same records, by name."""
        datasets = (
            replace(dataset, displacement=displacements[dataset.name]) for dataset in self.datasets
        )
        return replace(self, datasets=tuple(datasets))

    def with_readings_of(self, other: Posterior) -> Posterior:
        """Return the posterior of its own readings and of another's, with the same parameters."""
        return replace(self, datasets=self.datasets + other.datasets, joint=self.table)

    @cached_property
    def _by_record(self) -> dict[str, Posterior]:
        """The posterior of each record alone."""
        if len(self.datasets) == 1:
            return {self.single_record.name: self}
        posteriors = {}
        for dataset in self.datasets:
            columns = self.table.columns_of[dataset.name]
            parameters = (self.prior.parameters[column] for column in columns)
            prior = JointPrior(
                (replace(p, name=p.plain, record="") for p in parameters), self.prior.constraint
            )
            posteriors[dataset.name] = Posterior((dataset,), prior, self.engine)
        return posteriors

    def for_record(self, record: str) -> Posterior:
        """Return the posterior of one record alone, its parameters by their plain names."""
        return self._by_record[record]

    def select_draws(self, draws: FloatArray, record: str) -> FloatArray:
        """Return the columns of draws (draws, free) that are free parameters of a record alone."""
        names = (self.table.name_of(name, record) for name in self.for_record(record).names)
        columns = [self.names.index(name) for name in names]
        columns_of: FloatArray = draws[..., columns]
        return columns_of

    def each(self, draws: FloatArray) -> Iterator[tuple[str, Posterior, FloatArray]]:
        """Yield each record's name, its own posterior, and its parameters of draws (draws, free).

        These are (draws, free of that posterior), in their own units.
        """
        for dataset in self.datasets:
            name = dataset.name
            yield name, self.for_record(name), self.select_draws(draws, name)

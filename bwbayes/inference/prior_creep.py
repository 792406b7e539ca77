"""Creep that a record cannot show, added to a fit for what it is to predict.

Every piezo actuator creeps, by one or two percent of the displacement a decade of time, and a short
record of a fast drive cannot tell: what creeps within a period is part of the gain there, and what
takes longer than the record is not in it. A slow plan or a long hold brings it out. So a fit that
has no creep is extended for its predictions: lags reach from the drive that was fitted to the
plan's length, and their strengths keep the prior where the readings say nothing of them.

The coordinates z of the longer model are found from the fit's by Gauss and Newton's steps,

    H = I + Q,   z → z + H⁻¹ (u − Q z),

where u and I are the likelihood's gradient and Fisher information in z, the noise held
(:meth:`~bwbayes.inference.mode_finding.Target.linearize`), and Q is the prior's precision: one, but
between the strengths, which are alike. Strengths c are drawn from the normal distribution of that
mode, and each draw of the fit moves with its own, by the mode's move and −H_φφ⁻¹ H_φc (c − ĉ): the
gain of a fast drive gives way to the creep in it, and what is predicted of such a drive stays as it
was. Such a record cannot tell either whether there is any creep: one in eight draws does without,
in case a lead-in shows that there is none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bwbayes.arrays import FloatArray
from bwbayes.inference.mode_finding import Target
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.posterior import Posterior
from bwbayes.model.inputs import Span, time_between_turns
from bwbayes.model.linear import Creep, creep_times


def add_prior_creep(
    posterior: Posterior, draws: FloatArray, duration: float, generator: np.random.Generator
) -> tuple[Posterior, FloatArray]:
    """Return a fit's posterior with creep in its model, and its draws with strengths of creep.

    Parameters
    ----------
    posterior
        The fitted posterior. A model with creep is returned as it is.
    draws
        Its draws, (draws, free), parameters in their own units.
    duration
        Duration of the prediction, s.
    generator
        Draws the strengths.
    """
    if any(dataset.actuator.creep for dataset in posterior.datasets):
        return posterior, draws
    extended, creep = _with_creep(posterior, duration)
    columns = dict(zip(posterior.names, draws.T, strict=True))
    columns |= {name: np.zeros(len(draws)) for name in creep.names}
    places = extended.prior.unconstrain(np.stack([columns[n] for n in extended.names], axis=1))
    target = Target(extended)
    moving = target.physical
    added = np.array([moving.tolist().index(extended.names.index(n)) for n in creep.names])
    unmoved = np.setdiff1d(np.arange(moving.size), added)
    strengths, others = moving[added], moving[unmoved]
    # Creep goes with the logarithm of the time: strengths a decade of it apart are alike.
    decades = np.abs(np.subtract.outer(np.log10(creep.times), np.log10(creep.times)))
    prior = np.eye(moving.size)
    prior[np.ix_(added, added)] = np.linalg.inv(0.9**decades)

    begin = places.mean(axis=0)
    begin[strengths] = 0.0  # the mean of the prior: without any creep its start is another one
    mode, hessian = begin.copy(), prior
    for _ in range(4):  # steps to the mode
        linear = target.linearize(mode[np.newaxis])
        hessian = linear.fisher_information[0] + prior
        mode[moving] += np.linalg.solve(hessian, linear.gradient[0] - prior @ mode[moving])
    across = hessian[np.ix_(unmoved, added)]
    follow = np.linalg.solve(hessian[np.ix_(unmoved, unmoved)], across)
    precision = hessian[np.ix_(added, added)] - across.T @ follow
    covariance = np.linalg.inv((precision + precision.T) / 2)
    # One in eight does without: enough for a lead-in to choose among them alone.
    crept = np.arange(len(draws)) % 8 > 0
    drawn = generator.multivariate_normal(mode[strengths], covariance, size=int(crept.sum()))
    shift = (mode - begin)[others] - (drawn - mode[strengths]) @ follow.T
    places[np.ix_(crept, others)] += shift
    places[np.ix_(crept, strengths)] = drawn
    longer = extended.prior.constrain(places)[0]
    # Exactly none, so that nothing is unknown of its start either.
    longer[np.ix_(~crept, [extended.names.index(name) for name in creep.names])] = 0.0
    return extended, longer


def _with_creep(posterior: Posterior, duration: float) -> tuple[Posterior, Creep]:
    """Return the posterior of the same records with creep, and the creep.

    It goes from what is as fast as the drives that were fitted to a plan's length.
    """
    turns = [
        time_between_turns(dataset.voltage, dataset.actuator.interval, dataset.training)
        for dataset in posterior.datasets
    ]
    # Creep that is a hundred times as fast as the drive between turning points is part of its gain.
    interval = max(
        min(dataset.actuator.interval for dataset in posterior.datasets), min(turns) / 100
    )
    longest = max(
        dataset.voltage.size * dataset.actuator.interval for dataset in posterior.datasets
    )
    spans = [dataset.span for dataset in posterior.datasets]
    span = Span(min(span.low for span in spans), max(span.high for span in spans))
    creep = Creep(tuple(creep_times(interval, max(duration, longest))), reference=span)
    datasets = tuple(
        replace(dataset, actuator=replace(dataset.actuator, creep=creep))
        for dataset in posterior.datasets
    )
    declared = {parameter.name: parameter for parameter in posterior.prior.parameters}
    declared |= {
        declaration.name: Parameter.of(declaration, creep.strength)
        for declaration in creep.parameters
    }
    joint = replace(posterior.table, actuator_part=datasets[0].actuator)
    prior = JointPrior((declared[name] for name in joint.names), posterior.prior.constraint)
    return Posterior(datasets, prior, posterior.engine, joint), creep

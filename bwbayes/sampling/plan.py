"""Plan of a sampling: the walkers, the target, the budget, and the cost of a step.

On a short record, Python takes most of the time of a step, whatever the models in it: there an
independence move draws the tries of several steps at once, and a step has several tries.
"""

from __future__ import annotations

from dataclasses import dataclass

from bwbayes.errors import InputError


@dataclass(frozen=True)
class SamplingPlan:
    """Settings of a sampling, and its stopping rule.

    Parameters
    ----------
    ess
        Effective draws of every parameter, bulk and tail, to reach.
    ensembles
        Independent ensembles, at least four: R-hat compares them.
    walkers
        Walkers of one ensemble, even, at least twice the free parameters.
    block
        Steps that are made and stored at a time; checks come after whole blocks.
    max_steps, max_pilot_steps
        The budget: steps of each ensemble that count, and of the pilot.
    min_pilot_steps
        Least number of steps of the pilot.
    ensembles_per_task
        Ensembles that one task advances.
    tries
        Tries of an independence move that counts, for each walker and step.
    ahead
        Number of steps whose tries an independence move draws at once.
    """

    ess: float = 2000.0
    ensembles: int = 4
    walkers: int = 24
    block: int = 50
    max_steps: int = 20_000
    min_pilot_steps: int = 25
    max_pilot_steps: int = 3_000
    ensembles_per_task: int = 1
    tries: int = 1
    ahead: int = 1

    def __post_init__(self) -> None:
        if self.ensembles < 4:
            raise InputError("sampling.ensembles: needs at least 4; R-hat compares them")
        if self.walkers % 2:
            raise InputError("sampling.walkers: must be even; emcee moves one half at a time")


def best_ensembles_per_task(ensembles: int, walkers: int, samples: int) -> int:
    """Return the number of ensembles that one task advances, on a record of so many samples.

    If a step is cheap, a task advances all: threads would wait for each other's Python code. If the
    models take as long as Python, a task advances half of them, for two threads; else, one.
    """
    size = walkers * samples
    return ensembles if size <= 1 << 16 else ensembles // 2 if size <= 1 << 18 else 1


def best_tries(walkers: int, readings: int) -> int:
    """Return the number of tries of an independence move, for so many readings.

    Records with few readings get several, up to 32 readings and with 64 walkers four: their
    posteriors are wide and curved, and the mixture covers them badly.
    """
    return max(1, min(4, (1 << 13) // (walkers * readings)))


def best_ahead(walkers: int, samples: int) -> int:
    """Return the number of steps whose tries are drawn at once, on a record of so many samples.

    It is eight if a call of the density costs more than the models in it. Tries left over from a
    block of steps are lost, which would cost more than the calls if models are expensive.
    """
    return max(1, min(8, (1 << 17) // (walkers * samples)))

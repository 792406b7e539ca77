"""How a posterior is sampled: the walkers, the target, the budget, and what a step may cost.

On a short record a step is mostly Python's work, whatever the models in it: there an independence
move draws the tries of several steps at once, and a step has several tries to choose from.
"""

from __future__ import annotations

from dataclasses import dataclass

from bwbayes.errors import InputError


@dataclass(frozen=True)
class SamplingPlan:
    """How to sample, and when to stop.

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
        The budget: steps of each ensemble that count, and before.
    min_pilot_steps
        Steps of the pilot in any case.
    ensembles_per_task
        Ensembles that one task advances.
    tries
        Tries of an independence move that counts, for each walker and step.
    ahead
        Steps of which an independence move draws the tries at once.
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
    """Return how many ensembles one task advances, on a record of so many samples.

    All where a step is light: threads would wait for each other's Python. Half of them, for two
    threads, where the models take as long as Python does. Else each by itself.
    """
    size = walkers * samples
    return ensembles if size <= 1 << 16 else ensembles // 2 if size <= 1 << 18 else 1


def best_tries(walkers: int, readings: int) -> int:
    """Return how many tries an independence move has, for so many readings.

    Several where readings are few, four of up to 32 with 64 walkers: what they leave open is wide
    and curved, and the mixture covers it badly.
    """
    return max(1, min(4, (1 << 13) // (walkers * readings)))


def best_ahead(walkers: int, samples: int) -> int:
    """Return of how many steps tries are drawn at once, on a record of so many samples.

    Of eight where a call of the density costs more than the models in it. What a block of steps
    leaves over is lost, which where models are dear would cost more than the calls.
    """
    return max(1, min(8, (1 << 17) // (walkers * samples)))

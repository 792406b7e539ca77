"""The snooker move leaves a distribution as it is, and the phases use the moves they promise.

How sure :func:`~tests.inference.problems.worst_score` is, and how rarely wrong, is told there.
"""

from __future__ import annotations

import emcee
import pytest

from bwbayes.inference.moves import SnookerMove, pilot_moves, sampling_moves
from tests.inference.problems import ALARM, TARGETS, worst_score


@pytest.mark.parametrize("name", TARGETS)
def test_the_snooker_move_leaves_the_right_distribution(name: str) -> None:
    assert worst_score(TARGETS[name], [(SnookerMove(), 1.0)]) < ALARM


def test_twin_half_of_the_snooker_factor_is_found() -> None:
    """The move of emcee itself, up to 3.1.6, in nine dimensions."""
    halved = emcee.moves.DESnookerMove()
    assert worst_score(TARGETS["gaussian"], [(halved, 1.0)], steps=40) > ALARM


def test_a_quarter_of_the_steps_stays_differential_evolution_and_snooker() -> None:
    proposal = TARGETS["banana"].proposal
    weights = {type(move).__name__: weight for move, weight in sampling_moves(proposal)}
    assert 1.0 == pytest.approx(sum(weights.values()))
    assert 0.25 == pytest.approx(weights["DEMove"] + weights["SnookerMove"])
    assert {"MHMove", "DEMove", "SnookerMove"} == set(weights)


def test_without_a_proposal_the_pilots_moves_go_on() -> None:
    names = [(type(move).__name__, weight) for move, weight in pilot_moves()]
    assert {"DEMove", "SnookerMove"} == {name for name, _ in names}
    assert names == [(type(move).__name__, weight) for move, weight in sampling_moves(None)]

"""How the walkers move: differential evolution, with a snooker step now and then.

Both are emcee's. A step along the difference of two other walkers follows any ridge the ensemble
lies on, whatever its scale; the snooker step reaches along a line through a third one and helps
between modes.
"""

from __future__ import annotations

from emcee import moves

__all__ = ["default_moves"]


def default_moves() -> list[tuple[moves.Move, float]]:
    """Return emcee's moves and their weights: four fifths differential evolution, a fifth snooker."""
    return [(moves.DEMove(), 0.8), (moves.DESnookerMove(), 0.2)]

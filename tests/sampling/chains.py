"""Chain files to test with: what is written is made up, and always the same."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bwbayes.inference.map_estimate import MAPEstimate
from bwbayes.sampling.chain import PHASES, Block, Chain, ChainFile, EnsembleState, Phase
from bwbayes.sampling.curvature import PolynomialMap, SkewMap, TotalRatioMap
from bwbayes.sampling.proposals import StudentMixture

ENSEMBLES, WALKERS, FREE, STEPS = 4, 16, 8, 50
ATTRIBUTES: dict[str, str | int] = {
    "config": '[record]\nfile = "µm.csv"\n',
    "data_sha256": "94fd",
    "versions": '{"numpy": "2.0"}',
    "platform": "Linux",
    "seed": 7,
}
# The steps of a writer, in order, and where it may be interrupted.
PLAN: tuple[tuple[Phase, int], ...] = (("pilot", 2), ("tuning", 2), ("sampling", 10))


def state(generator: np.random.Generator) -> EnsembleState:
    words = generator.integers(2**32, size=628, dtype=np.uint32)
    words[624:626] = 17, 0  # a position that a generator may have, and no normal kept
    coordinates = generator.standard_normal((WALKERS, FREE))
    return EnsembleState(coordinates, generator.standard_normal(WALKERS), words)


@cache
def blocks(phase: Phase, number: int) -> list[Block]:
    generator = np.random.default_rng([PHASES.index(phase), number])
    made = []
    for _ in range(ENSEMBLES):
        end = state(generator)
        coordinates = generator.standard_normal((STEPS, WALKERS, FREE))
        density = generator.standard_normal((STEPS, WALKERS))
        coordinates[-1], density[-1] = end.coordinates, end.log_density
        accepted = generator.integers(STEPS, size=WALKERS)
        counts = generator.integers(1, STEPS, size=(3, 2)).tolist()
        moves = {f"move {number}": tuple(pair) for number, pair in enumerate(counts)}
        made.append(Block(coordinates, density, accepted, moves, end))
    return made


def proposal(phase: Phase) -> StudentMixture:
    generator = np.random.default_rng(PHASES.index(phase))
    factors = np.tril(generator.standard_normal((4, FREE, FREE)))
    centers = generator.standard_normal((4, FREE))
    weights = generator.dirichlet(np.ones(4))
    if phase != "sampling":
        return StudentMixture(weights, centers, factors)
    terms, bends, scales = np.array([[-1, -1, 0, 0]]), np.zeros((1, FREE)), np.zeros((FREE, FREE))
    bends[0, 1], scales[0, 1] = generator.standard_normal(2)
    totals = TotalRatioMap(np.array([[1, 0]]), centers[:1, :2], np.ones((1, 2)), np.array([2.0]))
    skew = SkewMap(centers[1], np.exp(centers[2]), np.full(FREE, 0.8))
    bend = PolynomialMap(centers[0], factors[0], terms, bends, scales)
    return StudentMixture(weights, centers, factors, (totals, skew, bend))


def new(path: Path) -> ChainFile:
    generator = np.random.default_rng(0)
    mode = generator.standard_normal(FREE)
    point = MAPEstimate(mode, np.eye(FREE), -3.5, np.stack([mode, -mode]), 4 * np.eye(FREE))
    chain = Chain([state(generator) for _ in range(ENSEMBLES)])
    chain.freeze("pilot", proposal("pilot"))
    return ChainFile.create(path, chain, point, STEPS, ATTRIBUTES)


def finish(chain: Chain) -> None:
    for phase, count in PLAN:
        if phase != "pilot" and not chain.blocks(phase):
            chain.freeze(phase, proposal(phase))
        while chain.blocks(phase) < count:
            chain.append(phase, blocks(phase, chain.blocks(phase)))


def arrays(chain: Chain) -> dict[str, Any]:
    held: dict[str, Any] = {}
    if isinstance(chain, ChainFile):
        held |= {f"point {name}": np.array(value) for name, value in vars(chain.point).items()}
    for phase in PHASES:
        held[f"{phase} blocks"] = np.array(chain.blocks(phase))
        held[f"{phase} moves"] = np.array(list(chain.moves(phase).values()))
        if chain.blocks(phase):
            for name in ("coordinates", "log_density", "accepted"):
                held[f"{phase} {name}"] = getattr(chain, name)(phase)
        for number, row in enumerate(chain.history(phase)):
            ends = [block.end.random_state for block in row]
            held[f"{phase} {number} random states"] = np.stack(ends)
        mixture = chain.proposal_in_use(phase)
        if mixture is not None:
            held |= {f"{phase} {name}": value for name, value in mixture.arrays().items()}
    for kind, states in (("start", chain.starts), ("end", chain.ends)):
        for name in ("coordinates", "log_density", "random_state"):
            held[f"{kind} {name}"] = np.stack([getattr(one, name) for one in states])
    return held


def assert_same(expected: dict[str, Any], got: dict[str, Any]) -> None:
    assert expected.keys() == got.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(value, got[name], err_msg=name)

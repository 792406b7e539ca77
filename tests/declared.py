"""Declarations of the model's parts, by parameter name, for tests that put models together."""

from dataclasses import replace

from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.inference.study import every_declaration
from bwbayes.model.declaration import Context, Declaration, Distribution, Ranges
from bwbayes.model.operators.bouc_wen import BoucWen

BOUC_WEN = BoucWen()
DECLARED = {d.name: d for d in every_declaration()} | {d.name: d for d in BOUC_WEN.parameters}

# Those of Bouc-Wen, the filters, the offset and the noises.
NAMES = (
    "d", "alpha", "beta", "gamma", "exponent", "initial", "lag", "mass", "damping", "stiffness",
    "offset", "sensor_sd", "discrepancy_sd", "discrepancy_time",
)  # fmt: skip


def declared(name: str) -> Declaration:
    """Return a declaration; Bouc-Wen's where several operators have a parameter of that name."""
    return DECLARED[name]


def parameter(
    name: str, known: Distribution | float, lower: float | None = None, upper: float | None = None
) -> Parameter:
    one = Parameter.of(declared(name), known)
    return replace(
        one,
        lower=one.lower if lower is None else lower,
        upper=one.upper if upper is None else upper,
    )


def joint(parameters: list[Parameter], *, passive: bool = True) -> JointPrior:
    own = {d.name: d for d in BoucWen(passive).parameters}
    every = [replace(p, declared=own.get(p.name, p.declared)) for p in parameters]
    return JointPrior(every, BoucWen(passive).holds)


def context(
    ranges: Ranges, exponent: float | Distribution = 1.0, stiffness: float | None = None
) -> Context:
    stated: dict[str, float | Distribution] = {"exponent": exponent}
    return Context(ranges, stated if stiffness is None else stated | {"stiffness": stiffness})

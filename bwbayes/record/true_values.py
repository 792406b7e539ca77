"""True values for any actuator on the virtual stand, of the size of the paper's ring bender.

A ring bender moves by about 60 um either way at 100 V, a tenth of it hysteresis. The medians of a
part's default priors are its true values where they make such an actuator; this module states the
other values in one table.
"""

from __future__ import annotations

from collections.abc import Mapping

from bwbayes.errors import InputError
from bwbayes.model.actuator import Actuator
from bwbayes.model.declaration import Context, Ranges
from bwbayes.model.distributions import Distribution
from bwbayes.model.operator import Operator
from bwbayes.model.operators.backlash_like import BacklashLike
from bwbayes.model.operators.bouc_wen import BoucWen
from bwbayes.model.operators.bouc_wen_asymmetric import BoucWenAsymmetric
from bwbayes.model.operators.duhem import Duhem

# The paper's ring bender on its identification signal: +-100 V at 1 Hz, +-62 um.
RING_BENDER = Ranges(
    voltage=100.0,
    displacement=62.0,
    middle=0.0,
    time=0.5,
    interval=1e-3,
    duration=16.0,
    covariates={"temperature_degC": (20.0, 25.0)},
)

# True values where medians are no guide: other parameters' bounds cut the prior, or it is centered
# at zero. They give the ring bender's loops at 100 V, and visible further terms.
OPERATORS: Mapping[type[Operator], Mapping[str, float]] = {
    BacklashLike: {"d": 0.7, "alpha": 0.35, "beta": 0.04, "initial": 0.0},
    BoucWenAsymmetric: {
        "d": 0.7,
        "alpha": 0.3575,
        "beta": 0.04,
        "gamma": 0.01,
        "b2": 0.1,
        "b3": 0.1,
        "b4": -0.1,
        "b5": 0.1,
        "b6": 0.15,
        "initial": 0.0,
    },
    Duhem: {
        "d": 0.65,
        "d3": 3e-6,
        "alpha": 0.3,
        "beta": 0.04,
        "alpha2": 1e-5,
        "d2": 2e-4,
        "alpha1": 1e-3,
        "initial": 0.0,
    },
}
GAIN = {"quadratic": 3.0, "cubic": -2.0}
LAG = {"lag": 0.005}


def true_values(actuator: Actuator, table: Mapping[str, float]) -> dict[str, float]:
    """Return values of all parameters of an actuator, by name and in their order.

    ``table`` holds those of Bouc-Wen hysteresis, of a mass on a spring and of the sensor's offset.

    Raises
    ------
    InputError
        A parameter has no known value: its part is from outside the package and states no default
        prior.
    """
    operator = actuator.hysteresis
    stated = table if isinstance(operator, BoucWen) else OPERATORS.get(type(operator), {})
    of_operator = {declared.name for declared in operator.parameters}
    values = {n: value for n, value in {**table, **GAIN, **LAG}.items() if n not in of_operator} | {
        **stated
    }
    for name, declared in zip(actuator.parameters, actuator.declarations, strict=True):
        if name not in values:
            default = declared.default(Context(RING_BENDER))
            if default is None:
                raise InputError(f"test stand: {name}: has no default; give a true value")
            if isinstance(default, Distribution):
                default = float(default.frozen.median())
            values[name] = default
    return {name: values[name] for name in actuator.parameters}

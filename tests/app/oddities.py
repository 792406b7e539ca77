"""A good record, good configs, and what is written into them that does not belong there."""

from __future__ import annotations

import math
from typing import Any

__all__ = [
    "CONFIGS",
    "GOOD",
    "ODD_CELLS",
    "ODD_KEYS",
    "ODD_LINES",
    "ODD_NAMES",
    "ODD_NOTES",
    "ODD_VALUES",
    "QUICK",
    "ROWS",
]

ROWS = [f"{i / 100:.2f},{5 * math.sin(i):.4f},{2 * math.cos(1.3 * i):.4f}" for i in range(40)]
GOOD = ["# voltage: output", "# origin: a bench", "time_s,voltage_V,displacement_um", *ROWS]

QUICK = """\
[record]
file = "record.csv"

[model]
dynamics = "none"
noise = "white"
"""

CONFIGS = (
    QUICK
    + """
[parameters]
alpha = { prior = { distribution = "lognormal", median = 0.2, sigma = 0.5 }, upper = 0.9 }
initial = { fixed = 0.0 }
d = { unit = "um/V", label = "d_0", description = "a gain" }

[sampling]
ess = 100
ensembles = 4
walkers = 24
""",
    """\
name = "bench"
seed = 3

[record]
file = "record.csv"
voltage_is = "command"
start = 0.0
stop = 0.4
decimate = 1
train = [[0.0, 0.2]]

[validation.held-out]
window = [0.2, 0.3]

[validation.other]
file = "record.csv"
own_offset = true
lead_in = 0.1
""",
    """\
[record]
signal = { shape = "triangle", amplitude = 100.0, frequency = 1.0, duration = 3.0, decay = 0.1 }

[stand]
sample_rate = 20.0
discrepancy = "none"

[model]
dynamics = "second-order"
hold = "zero"

[parameters]
mass = { fixed = 0.00134 }
stiffness = { fixed = 4.10e5 }
exponent = { fixed = 1.5, lower = 1.0 }

[truth]
d = 0.7

[validation.sine]
signal = { amplitude = 60.0, frequency = 0.5, duration = 4.0 }
from_rest = true
lead_in = 0.5
""",
)

ODD_CELLS = (
    *("nan", "-NaN", "inf", "-Infinity", "1e999", "-1e999", "1e308", "1e-320", "5e-324", "-0"),
    *("1e9", "1e10", "-1e12", "1_000", "1,000", '"1,000"', "1.000,5", "1 000", "1;5", "0x1F", "1j"),
    *("١٢٣", "１２", "½", "1\u200b", "\u00a01", "−1", "1e", "e5", "+-1", "--1", ".", "", " "),
    *("9" * 400, "0." + "1" * 400, "1" * 5000, "True", "None", "=1+1", "#", "'1'", "1\t2", "\0"),
    *(
        "<b>1</b>",
        "\x1b[31m1",
        "[/red]",
        "1\x0b",
        "1\x85",
        "1\u20282",
        "time_s",
        "../../x",
        "\ud7ff",
    ),
)
ODD_NAMES = (
    *("time_ms", "time_us", "TIME_S", "time", "time_V", "voltage_mV", "voltage_kV", "voltage_um"),
    *("displacement_m", "displacement_nm", "truth_um", "", "x", "_", "_s", "time_s\x1b[2J", "1.5"),
    *("a" * 5000, "<script>", "[/]", "voltage_µV", "\u202evoltage_V", "time__s", "None", "0"),
)
ODD_NOTES = (
    *("# voltage: comand", "# voltage:", "# voltage: command", "# interval_s: 0.01", "#"),
    *("# interval_s: nan", "# interval_s: -1", "# interval_s: 1e999", "# interval_s: 0,01"),
    *("# origin: <script>alert(1)</script>", "# origin: [/red]", "# origin: \x1b[31m", "# :"),
    *("# origin: " + "x" * 100_000, "# truth: 1", "# " * 3000, "#\u2028# voltage: x", "   # x: y"),
)
ODD_VALUES: tuple[Any, ...] = (
    *(0, 1, -1, 3, 2**31, 2**63, -(2**63), 10**30, 10**400, 10**5000, True, False),
    *(0.0, -0.0, 0.5, 1.0, -1.5, 1e-9, 5e-324, 1e-300, 1e9, 1e300, 1.7e308),
    *(math.nan, math.inf, -math.inf),
    *("", "a", "nan", "1", "record.csv", "none.csv", "/", ".", "..", "../..", "/dev/null", "a\0b"),
    *(
        "/dev/zero",
        "record.csv/x",
        "~",
        "x" * 5000,
        "<b>",
        "[/red]",
        "\x1b[31m",
        "\n",
        "\u2028",
        "é",
    ),
    *("identification", "step10", "sine", "normal", "cauchy", "alpha", "lag", "white", "auto"),
    *([], {}, [[]], [{}], [1, 2], [1.0, 2.0], [[0.0, 0.2]], [[0.2, 0.1]], [[0.0, math.inf]]),
    *([[0.0, 0.1], [0.05, 0.2]], [0.1] * 500, {"a": 1}, {"distribution": "normal"}),
    *({"distribution": "normal", "mean": 0.0, "sd": 0.0}, {"distribution": "beta", "a": 1e300}),
    *({"distribution": "normal", "mean": 1e300, "sd": 1e-300}, {"fixed": 1e300}, {"fixed": -1.0}),
    *({"distribution": "uniform", "lower": 0.0, "upper": 1e308}, {"distribution": "t", "df": 1e-9}),
    *({"distribution": "lognormal", "median": 1e-300, "sigma": 1e3}, {"prior": {}}, {"lower": 9.0}),
    *({"amplitude": 1e308, "frequency": 1e-300, "duration": 1e300}, {"window": [0.1, 0.3]}),
)
ODD_KEYS = (
    *("file", "signal", "window", "train", "prior", "fixed", "lower", "upper", "unit", "label"),
    *("record", "model", "parameters", "validation", "truth", "sampling", "stand", "seed", "name"),
    *("d", "alpha", "beta", "gamma", "exponent", "offset", "lag", "mass", "sensor_sd", "training"),
    *("", " ", ".", "..", "../x", "a/b", "a\0", "\n", "é", "x" * 300, "<b>", "__class__", "[/red]"),
    *("model_config", "model_fields", "self", "1", "-", "con", "held-out", "\x1b[31m", "\u2028"),
)
ODD_LINES = (
    *("[", "]", "[[record]]", "[record]", "[record.file]", "= 1", "a = ", "a = 1", "'", '"""', "#"),
    *("[" + ".".join("a" * 3000) + "]", ".".join("a" * 3000) + " = 1", "[parameters.d.d.d]"),
    *(
        "x = " + "[" * 3000,
        "x = " + "[" * 3000 + "]" * 3000,
        "x = " + "{a=" * 3000 + "1" + "}" * 3000,
    ),
    *(
        "seed = " + "9" * 5000,
        "seed = 0x" + "f" * 5000,
        "seed = 1_0",
        "seed = 1979-05-27T07:32:00Z",
    ),
    *(
        "seed = 9999-99-99",
        "name = '" + "x" * 200_000 + "'",
        "a" * 200_000 + " = 1",
        "# " + "x" * 200_000,
    ),
    *('name = "\\uD800"', 'name = "\\U0010FFFF"', 'name = "\\x"', "seed = ١", "seed = 1e999", "\0"),
    *('name = """\n\n"""', "seed = +nan", "[validation.'a/../../b']", '[validation."\\u0000"]'),
)

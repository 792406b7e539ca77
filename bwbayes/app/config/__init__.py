"""Configs: their keys, types, defaults and descriptions, and how TOML is read.

Here are constants that configs and the command line share, without waiting for what checks configs.
"""

# Numbers that files hold as integers.
MAX_SEED = 2**63 - 1

# Models that are compared if no others are named: from no hysteresis at all to the two ways of
# remembering it, a state or a stack of turning points, without and with the asymmetry of measured
# loops.
USUAL_MODELS = (
    "linear; bouc-wen; bouc-wen + quadratic; bouc-wen + quadratic + cubic; "
    "prandtl-ishlinskii + quadratic + cubic; maxwell-slip(thresholds=4) + quadratic; "
    "maxwell-slip(thresholds=4) + quadratic + cubic"
)

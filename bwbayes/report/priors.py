"""The table of priors: as stated, and as the physical constraints leave them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from bwbayes.diagnosis.conflict import effective
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.report.report import Table, TableColumn
from bwbayes.report.tables import name_columns
from bwbayes.report.words import unit_text

__all__ = ["priors_table"]


def priors_table(prior: JointPrior, point: Mapping[str, float] | None = None) -> Table:
    """Return each parameter's prior, stated and in effect, or its fixed value.

    The prior in effect is what the physical constraints leave of the stated one: median and 95 %
    interval under the joint prior. On the screen it stands below the stated one where it differs.
    ``point`` has the parameters of a point fit, if there is one.
    """
    quantiles = effective(prior, np.random.default_rng(0))
    in_effect = dict(zip(prior.free_names, quantiles.T, strict=True))

    def effect(parameter: Parameter) -> str:
        if parameter.prior is None:
            return ""
        low, median, high = in_effect[parameter.name]
        return f"{median:.3g} ({low:.2g} to {high:.2g})"

    def short(parameter: Parameter) -> str:
        if parameter.prior is None:
            return f"fixed at {parameter.fixed:g}"
        probabilities = parameter.prior.frozen.cdf(in_effect[parameter.name])
        # Constraints that move a quantile by less are not told from the draws' own error.
        is_cut = max(abs(probabilities - [0.025, 0.5, 0.975])) > 0.03
        return f"{parameter.prior}" + (f"\n  effective: {effect(parameter)}" if is_cut else "")

    def estimate(parameter: Parameter) -> str:
        return f"{point[parameter.name]:.5g}" if point and parameter.name in point else ""

    bounds = [
        parameter.declared.stated_bounds
        for parameter in prior.parameters
        if parameter.declared is not None and parameter.declared.stated_bounds
    ]
    cut = Markup("bounds of the parameters have cut it")
    if bounds:
        cut = Markup(
            'model\'s own constraints (<span id="constraints">{}</span>) have cut the joint prior'
        ).format("; ".join(bounds))
    return Table.of(
        "priors",
        "Priors and fixed values",
        prior.parameters,
        (
            *name_columns("Parameter"),
            TableColumn("Prior or value", on="page", text=_stated),
            TableColumn("Prior", on="screen", text=short),
            TableColumn("Effective", on="page", text=effect),
            TableColumn("MAP estimate", on="both" if point else "nowhere", text=estimate),
            TableColumn("Unit", text=lambda parameter: unit_text(parameter.unit)),
        ),
        note=Markup(
            "Effective: median, with the 2.5 % and 97.5 % quantiles, of each prior once the {}. "
            "The scales of default priors come from the training data's ranges of voltage and "
            "displacement and from the drive's times."
        ).format(cut),
        on="both",
    )


def _stated(parameter: Parameter) -> str:
    """Return a prior in words, with the bounds that cut it, or a fixed value."""
    if parameter.fixed is not None:
        return f"fixed at {parameter.fixed:.6g}"
    text = str(parameter.prior)
    if math.isfinite(parameter.lower):
        text += f", at least {parameter.lower:.6g}"
    if math.isfinite(parameter.upper):
        text += f", at most {parameter.upper:.6g}"
    return text

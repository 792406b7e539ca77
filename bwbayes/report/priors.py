"""The table of priors: as stated, and as the physical constraints leave them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from bwbayes.diagnosis.conflict import effective
from bwbayes.inference.parameters import JointPrior, Parameter
from bwbayes.report.report import Table, TableColumn
from bwbayes.report.tables import name_columns, parameter_words
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
    rows = []
    for parameter in prior.parameters:
        effect, brief = "", f"fixed at {parameter.fixed:g}" if parameter.prior is None else ""
        if parameter.prior is not None:
            low, median, high = in_effect[parameter.name]
            effect, brief = f"{median:.3g} ({low:.2g} to {high:.2g})", str(parameter.prior)
            probabilities = parameter.prior.frozen.cdf([low, median, high])
            # Constraints that move a quantile by less are not told from the draws' own error.
            if max(abs(probabilities - [0.025, 0.5, 0.975])) > 0.03:
                brief += f"\n  in effect {effect}"
        rows.append(
            (
                parameter_words(parameter),
                parameter.name,
                _stated(parameter),
                brief,
                effect,
                f"{point[parameter.name]:.5g}" if point and parameter.name in point else "",
                unit_text(parameter.unit),
            )
        )
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
    return Table(
        "priors",
        "Priors and fixed values",
        (
            *name_columns("Parameter"),
            TableColumn("Prior or value", on="page"),
            TableColumn("Prior", on="screen"),
            TableColumn("In effect", on="page"),
            TableColumn("Point fit", on="both" if point else "nowhere"),
            "Unit",
        ),
        rows,
        note=Markup(
            "In effect: median, with the 2.5 % and 97.5 % quantiles, of each prior once the {}. "
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

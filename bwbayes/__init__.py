"""Bayesian uncertainty of piezoelectric actuators with the Bouc-Wen hysteresis model.

A record of voltage and displacement becomes a posterior of the actuator's parameters, and the
posterior becomes bands in which the displacement will be, for any voltage:
``fit = bwbayes.fit(record)`` samples until the chain has converged, and then there is
``fit.predict(new_record)``. The forward model alone is here too, for a batch
of parameters::

    import numpy as np
    import bwbayes

    voltage = 100 * np.sin(2 * np.pi * np.arange(0, 2, 1e-3))  # V
    h = bwbayes.hysteresis(voltage, alpha=[0.30, 0.36], beta=0.027, gamma=0.017)  # (2, 2000), um

The names here are what a Python user needs; each is loaded when it is first used, so that
``import bwbayes`` costs nothing. ``notebooks/quickstart.ipynb`` shows them at work. All else is
imported from its room: ``from bwbayes.model.actuator import Actuator``.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

__all__ = [
    "Bands",
    "Campaign",
    "InputError",
    "InputWarning",
    "NotConvergedError",
    "Prediction",
    "Record",
    "Run",
    "VirtualTestStand",
    "campaign",
    "compare",
    "fit",
    "hysteresis",
    "inspect",
    "open_run",
    "read_record",
    "resume",
    "signal",
    "write_record",
]

if TYPE_CHECKING:
    from bwbayes.app.fit.calls import campaign, compare, fit, open_run, resume
    from bwbayes.app.fit.fitted import Run
    from bwbayes.app.jobs.campaign import Campaign
    from bwbayes.app.jobs.predict import Prediction
    from bwbayes.diagnosis.record_checks import inspect
    from bwbayes.errors import InputError, InputWarning, NotConvergedError
    from bwbayes.model.operators.bouc_wen import hysteresis
    from bwbayes.prediction.bands import Bands
    from bwbayes.record.io.formats import read_record, write_record
    from bwbayes.record.record import Record
    from bwbayes.record.teststand import VirtualTestStand
    from bwbayes.record.waveforms import signal
else:

    def __getattr__(name: str) -> object:
        """Load a public name from where type checkers find it, above."""
        if name in __all__:
            line = rf"^    from (\S+) import (?:.*, )?{name}(?:,|$)"
            (home,) = re.findall(line, Path(__file__).read_text("utf-8"), re.MULTILINE)
            return getattr(import_module(home), name)
        missing = f"module {__name__!r} has no attribute {name!r}"
        if name == "Fit":
            missing += "; it is bwbayes.Run now"
        elif not name.startswith("_"):
            # Its room may have it.
            root = Path(__file__).parent
            defined = rf"^(?:(?:class|def) {re.escape(name)}\b|{re.escape(name)}(?::| =))"
            for path in sorted(root.rglob("*.py")):
                if re.search(defined, path.read_text("utf-8"), re.MULTILINE):
                    module = ".".join(path.relative_to(root.parent).with_suffix("").parts)
                    missing += f"; it is imported from its room: from {module} import {name}"
                    break
        raise AttributeError(missing)


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted(__all__)

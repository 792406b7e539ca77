"""What is said of a run's figures: their titles, what one reads from them, and what one would see.

By the first word of a figure's name: ``bands`` for ``bands_training``.
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["Caption", "caption"]


class Caption(NamedTuple):
    """A figure's title, how to read it, and what to say to those who do not see it."""

    title: str
    text: str
    alt: str


CAPTIONS = {
    "loop": Caption(
        "Hysteresis loop",
        "Displacement against voltage. New readings lie in the sensor band, the model in the "
        "parameter band.",
        "Displacement against voltage: readings, their mean, and the 95 % bands around it",
    ),
    "loops": Caption(
        "Major loop, minor loop and initial curve",
        "The model driven slowly, without dynamics, creep and offset. Left: displacement against "
        "voltage. Right: the same minus the straight line between the major loop's turning "
        "points, where the 95 % bands of the parameters can be seen.",
        "Displacement against voltage of major loop, minor loop and initial curve, with bands",
    ),
    "agreement": Caption(
        "Do the records agree?",
        "What each record's readings are off the joint fit, and off a fit of that record alone. "
        "The chi-square compares where both fits have the shared parameters with how far apart "
        "chance may put them.",
        "Residuals of each record in the joint fit and in a fit of its own, against time",
    ),
    "steps": Caption(
        "Step responses",
        "Displacement after a voltage step from zero, over the logarithm of time; on the right its "
        "growth from 0.1 s on. The step is ideal, whatever the amplifier did. Bands: 95 %, of the "
        "parameters.",
        "Displacement since a step, against the logarithm of time, with its band",
    ),
    "bands": Caption(
        "Over time",
        "Voltage, displacement, and readings minus mean. Of all readings, 95 % should lie inside "
        "the sensor band; those of a lead-in, if any, served to estimate the sensor's offset and "
        "are not judged. In the plot, the dots of a long record are the extremes of each short "
        "stretch: more of them lie outside than of all readings.",
        "Voltage, displacement with its 95 % bands, and readings minus mean, against time",
    ),
    "coverage": Caption(
        "Coverage and PIT",
        "Left: how much the bands cover, against what they promise; whiskers are one "
        "block-bootstrap standard error. It does not include that a record has one offset, and a "
        "posterior one estimate of the discrepancy: one record may be covered more or less than "
        "many are on average, and its PIT may lean. Right: how often readings fall at each "
        "predicted probability. A level line is right; a hump means bands that are too wide, a "
        "bowl too narrow, a slope a bias.",
        "Measured against promised coverage of the bands, and a histogram of the readings' PIT",
    ),
    "innovations": Caption(
        "Innovations",
        "What each fitted reading adds to those before it: its residual minus what they predict "
        "of it, over its standard deviation. If model and noise model are right these are "
        "independent standard normal numbers: white, on the line of the normal quantiles, of one "
        "size from the start on, and the same wherever the drive is. Whiskers are 95 % of chance.",
        "Autocorrelation, normal quantiles, course in time and size by drive of the innovations",
    ),
    "spectrum": Caption(
        "Spectrum of the residuals",
        "Amplitude spectral density of the residuals, and that of the noise model at the most "
        "probable draw. A peak above it is an oscillation that the noise model does not describe.",
        "Amplitude density of the residuals and of the noise model against frequency",
    ),
    "corner": Caption(
        "Posterior",
        "Each parameter, and each pair of parameters; contours hold 50 and 90 % of the draws. "
        "Crossing lines, if any, are the true values.",
        "Histogram of each parameter and contours of each pair of parameters",
    ),
    "trace": Caption(
        "Trace",
        "Each ensemble's mean over its walkers, step by step, and the spread of its walkers. "
        "Ensembles should lie on top of each other and not drift.",
        "Each parameter's mean and spread in each ensemble, step by step",
    ),
    "ranks": Caption(
        "Ranks",
        "How the ranks of each ensemble's draws among all draws are spread. Each line should stay "
        "near one, mostly inside the gray stripe that independent draws would fill.",
        "Histograms of ranks, one line for each ensemble and a panel for each parameter",
    ),
}


def caption(name: str) -> Caption:
    """Return what is said of a figure; of an unknown one, its name."""
    kind, _, record = name.partition("_")
    words = CAPTIONS.get(kind, Caption(kind, "", kind))
    if not record:
        return words
    return Caption(f"{words.title}: {record}", words.text, f"{words.alt} ({record})")

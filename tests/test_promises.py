"""What ``tests/README.md`` quotes is what was measured when the slow tests last ran in full."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from bwbayes.model.registry import HYSTERESIS
from bwbayes.results.bands import LEVELS
from tests.measured import measured
from tests.test_calibration_moving import MOST_UNCONVERGED
from tests.test_calibration_parts import EVERY, OPTIONS, REPLICATES

PROMISES = Path(__file__).with_name("README.md").read_text(encoding="utf-8")


def covered(discrepancy: str) -> str:
    """Say how much the intervals and bands of each level covered."""
    parts = measured()[f"coverage {discrepancy}"]["covered"]
    return ", ".join(
        f"{name} " + "/".join(f"{100 * parts[f'{name} {level}']:.0f}" for level in LEVELS)
        for name in ("parameters", "sensor", "displacement")
    )


def coverage() -> str:
    every = [measured()[f"coverage {kind}"]["errors_off"].values() for kind in ("process", "none")]
    worst = max(abs(off) for offs in every for off in offs)
    return (
        f"50/90/95 %: {covered('process')}; without a discrepancy {covered('none')}; none off by "
        f"more than {worst:.1f} standard errors"
    )


def calibration() -> str:
    one = measured()["calibration"]
    return (
        f"{one['replicates']} replicates, {one['unconverged']} not converged; {one['tests']} tests "
        f"of ranks and 9 of bands, {one['shortcomings']} failed; sds a fifth too small in one "
        f"parameter would be found with a probability of {one['power']:.2f}"
    )


def usual() -> str:
    start = "calibration, "
    every = {n.removeprefix(start): one for n, one in measured().items() if n.startswith(start)}
    told = ", ".join(
        f"{name} {one['unconverged']} of {one['replicates']}" for name, one in sorted(every.items())
    )
    little = every.pop("little noise")
    worst = max(
        abs(t) for one in every.values() for t in one["bands, standard errors off"].values()
    )
    assert not any(one["shortcomings"] for one in [*every.values(), little])
    wide = [100 * little["bands cover"][f"sensor {level}"] for level in (90, 95)]
    return (
        f"no test of ranks failed; none of {18 * len(every)} bands off by more than {worst:.1f} "
        f"standard errors; where the discrepancy is nearly all of the noise, 90 and 95 % bands of "
        f"the same record's held-out part cover {wide[0]:.0f} and {wide[1]:.0f} %; not converged "
        f"in their budget: {told}"
    )


def parts() -> str:
    start = "calibrated part, "
    every = {n.removeprefix(start): one for n, one in measured().items() if n.startswith(start)}
    assert not any(one["shortcomings"] for one in every.values())
    worst = max(
        abs(t) for one in every.values() for t in one["bands, standard errors off"].values()
    )
    missed = {name: one["unconverged"] for name, one in every.items()}
    bands = [
        100 * cover
        for one in every.values()
        for name, cover in one["bands cover"].items()
        if name.startswith("other") and name.endswith("sensor 95")
    ]
    many = {name: count for name, count in missed.items() if count > MOST_UNCONVERGED * REPLICATES}
    told = ", ".join(f"{name} {count}" for name, count in sorted(many.items()))
    most = max(set(missed.values()) - set(many.values()))
    late = ", ".join(sorted(set(EVERY) - set(every)))
    run = (f"{name} (`{OPTIONS[name].strip()}`)" if name in OPTIONS else name for name in every)
    return (
        f"{', '.join(sorted(run))}, {REPLICATES} replicates each: no test of ranks failed, none "
        f"of {18 * len(every)} bands is off by more than {worst:.1f} standard errors; 95 % sensor "
        f"bands of another record cover {min(bands):.1f} to {max(bands):.1f} %; not converged in "
        f"their budget at most {most}"
        + (f", but more than the tenth that is allowed of {told}" if many else "")
        + (f"; not run to the end: {late}" if late else "")
    )


def operators() -> str:
    one = measured()["operators named"]
    assert not one["recommended with a worse score"]
    return (
        f"{one['records']} records of nine operators, nine candidates each: the right one is named "
        f"alone in {one['named alone']}, named or left open in {one['named or left open']}; none "
        "is recommended with a held-out score that is worse by two errors"
    )


def kills() -> str:
    one = measured()["kills"]
    return f"{one['kills']} kills over {one['runs']} runs: none"


def hostile() -> str:
    used, refused = (measured()["hostile input"][key] for key in ("used", "refused"))
    return f"{used + refused:,} cases: {used:,} used, {refused:,} refused, nothing else"


def steady() -> str:
    one = measured()["steady sine"]
    covered = one["covered 95"].values()
    return (
        f"{one['converged']} of {one['records']}, after {one['most steps']:.0f} steps at most; "
        f"95 % intervals of eight parameters cover {min(covered)} to {max(covered)} of "
        f"{one['records']}"
    )


def verdicts() -> str:
    good, spoilt = measured()["good runs hold"], measured()["spoilt runs do not hold"].values()
    answers = ("seen", "right", "unsure", "missed")
    runs = {sum(kind.get(answer, 0) for answer in answers) for kind in spoilt}
    missed, unsure = (sum(kind.get(n, 0) for kind in spoilt) for n in ("missed", "unsure"))
    each = " to ".join(map(str, sorted({min(runs), max(runs)})))
    return (
        f"{len(good['said no'])} false alarms in {good['runs']} good runs; {missed} missed and "
        f"{unsure} left open of {len(spoilt)} kinds of spoilt ones, {each} each"
    )


def made_up() -> str:
    one = measured()["ordinary records"]
    return f"{one['records']} records: {len(one['refused'])} refused"


def ordinary() -> str:
    one = measured()["ordinary answers"]
    right, wrong = (Counter(one[kind]) for kind in ("correct", "other"))
    return (
        f"{one['seeds']} records: {right['True']} pass, {right['False']} fail; of another "
        f"actuator's, with a fifth more gain, {wrong['True']} pass and {wrong['False']} fail"
    )


def moving() -> str:
    every = [one for name, one in measured().items() if name.startswith("moving, ")]
    kinds, records = sum(one["cases"] for one in every), every[0]["records of each case"]
    cells = [cell for one in every for cell in one["coverage and t"].values()]
    parts = [100 * cell["95"][0] for cell in cells]
    worst = max(one["largest t"] for one in every)
    return (
        f"{kinds} kinds of {records} records: 95 % bands cover {min(parts):.1f} to "
        f"{max(parts):.1f} %, none of the {3 * len(cells)} bands of 50, 90 and 95 % is off by more "
        f"than {worst:.1f} standard errors"
    )


def moving_operators() -> str:
    start = "moving operators, "
    every = {n.removeprefix(start): one for n, one in measured().items() if n.startswith(start)}
    cells = [cell for one in every.values() for cell in one["coverage and t"].values()]
    parts = [100 * one["coverage and t"]["95"][0] for one in every.values()]
    wider = max(one["widening from rest"] for one in every.values())
    missing = sorted(set(HYSTERESIS) - set(every))
    return (
        f"{min(one['records'] for one in every.values())} records of each operator: 95 % bands "
        f"cover {min(parts):.1f} to {max(parts):.1f} %, none of the {len(cells)} bands of 50, 90 "
        f"and 95 % is off by more than {max(abs(t) for _, t in cells):.1f} standard errors; no "
        f"wider than {wider:.2f} times where a record did start from rest"
        + (f"; not run: {', '.join(missing)}" if missing else "")
    )


def nested() -> str:
    every = [one for name, one in measured().items() if name.startswith("every k-th sample")]
    counts = [text.split(" of ") for one in every for text in one["within one sd"].values()]
    near, compared = (sum(int(pair[i]) for pair in counts) for i in (0, 1))
    parts = [part["95"] for one in every for part in one["covered"].values()]
    smallest, limit = min(one["smallest p"] for one in every), every[0]["p of the family"]
    return (
        f"means differ as those of nested data do (smallest p {smallest:.0e}, limit {limit:.0e}); "
        f"{near:,} of {compared:,} are within one sd; 95 % bands cover {min(parts)} to "
        f"{max(parts)} % at every rate"
    )


def spikes() -> str:
    one = measured()["spikes set aside"]
    least, most = one["width over clean, least and most"]
    covered = one["covered 95"].values()
    return (
        f"{one['found']:,} of {one['spikes']:,} spikes and {one['good readings set aside']} good "
        f"readings; bands {least:.2f} to {most:.2f} as wide as without; 95 % intervals of nine "
        f"parameters cover {min(covered)} to {max(covered)} of {one['records']}"
    )


def closed_loop() -> str:
    one = measured()["closed loop"]
    return (
        f"for at least {100 * one['least_share_of_draws']:.1f} % of {one['draws']} draws, with "
        f"each of {one['seeds']} seeds of the stand, on every signal and at every frequency"
    )


def forecasts() -> str:
    one = measured()["forecasts from posteriors"]
    parts = [100 * part for part in one["95 % bands cover"].values()]
    return (
        f"{one['records']} records with parameters from the posterior: 95 % bands cover "
        f"{min(parts):.0f} to {max(parts):.0f} % at five distances"
    )


def specimens() -> str:
    one = measured()["campaign"]
    own, shrunk = (
        [100 * each[kind] for each in one.values() if isinstance(each, dict)]
        for kind in ("own", "shrunk")
    )
    sensor = "/".join(f"{100 * one[f'sensor {level}']:.1f}" for level in LEVELS)
    return (
        f"{one['specimens']} actuators: 95 % intervals of four parameters cover {min(own):.1f} to "
        f"{max(own):.1f} %, shrunk {min(shrunk):.1f} to {max(shrunk):.1f} %; 50/90/95 % sensor "
        f"bands {sensor} %; ten malformed records are reported, a line each"
    )


def populations() -> str:
    one = measured()["populations"]
    return (
        f"100 populations of 8: 95 % intervals of mean, spread and next specimen cover "
        f"{100 * one['mean']:.0f}, {100 * one['spread']:.0f} and {100 * one['new']:.0f} %, shrunk "
        f"ones {100 * one['shrunk']:.1f} %, {100 * one['width']:.0f} % as wide"
    )


def campaign() -> str:
    one = measured()["joint fit of the campaign"]
    covered = [round(part * one["seeds"]) for part in one["covered"].values()]
    widths = one["width, of that from the loops alone"]
    return (
        f"{one['seeds']} seeds: 95 % intervals of eight parameters cover {min(covered)} to "
        f"{max(covered)}; the damping's is {100 * widths['damping']:.0f} % as wide, the others' "
        f"{100 * min(widths[name] for name in widths if name != 'damping'):.0f} to "
        f"{100 * max(widths.values()):.0f} %"
    )


def agreement() -> str:
    one = measured()["joint fits: records that agree"]
    return (
        f"to rounding where one `continues` the other; as records of their own within 0.1 sd, if "
        f"ten correlation times of the discrepancy lie between them; {one['named']} of 200 sound "
        f"records are named, and {100 * one['named with 10 % more gain']:.0f} % of those with a "
        "tenth more gain"
    )


def inverse() -> str:
    ratios = measured()["inverse over simulation"].values()
    return f"{min(ratios):.1f} to {max(ratios):.1f} times"


def compensation() -> str:
    return _errors("compensation")


def compensation_by_a_dac() -> str:
    return _errors("compensation by a DAC")


def _errors(study: str) -> str:
    every = measured()[study]
    bands, rms = (
        "/".join(f"{100 * every[f'{kind} {level}'][0]:.0f}" for level in LEVELS)
        for kind in ("band", "rms")
    )
    worst = max(abs(off) for _, off in every.values())
    return (
        f"50/90/95 %: bands of the error cover {bands}, intervals of its rms {rms} %; none off by "
        f"more than {worst:.1f} standard errors"
    )


def long_fit() -> str:
    gib = measured()["long fit"]["gib"]
    return f"{gib:.2f} GiB at most, of a new process with all that it loads"


FINDINGS = [
    coverage,
    calibration,
    usual,
    parts,
    operators,
    kills,
    hostile,
    steady,
    verdicts,
    made_up,
    ordinary,
    moving,
    moving_operators,
    nested,
    spikes,
    closed_loop,
    forecasts,
    campaign,
    agreement,
    inverse,
    compensation,
    compensation_by_a_dac,
    specimens,
    populations,
    long_fit,
]


@pytest.mark.parametrize("finding", FINDINGS)
def test_the_quoted_findings_are_those_of_the_last_full_run(finding: Callable[[], str]) -> None:
    assert f"| {finding()} |" in PROMISES


def test_the_quoted_speeds_are_those_of_the_last_benchmarks() -> None:
    rows = re.findall(r"^\| (.+) \| ([\d.,]+) \|$", PROMISES, flags=re.MULTILINE)
    quoted = {name: float(value.replace(",", "")) for name, value in rows}
    assert quoted == pytest.approx(measured()["benchmarks"], rel=0.01)

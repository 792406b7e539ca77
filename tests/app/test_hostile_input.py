"""Ten thousand spoilt configs and records: each is used, or refused in one line.

Every case goes through ``bwbayes check`` in this process. Input that is used must give finite
numbers, and make a run's folder that reads back the same, with nothing written beside it. The best
of some prior draws stands in for the point fit, no misfit is explained and no page is drawn, which
take longer than all the rest, but for a few cases.

The default run takes the first 45, three of each kind, which find what befalls one case in 15 with
a probability of 0.95, and one noise; ``-m slow`` takes all, and chooses theirs. A case is made
again from its number: ``tests.app.test_hostile_input.case(SEED, number)``.
"""

import contextlib
import faulthandler
import io
import math
import re
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
import scipy.io

from bwbayes.app.commands import cli
from bwbayes.app.config.config import load
from bwbayes.app.fit.fitted import Run
from bwbayes.app.jobs import check as app_check
from bwbayes.app.running import explaining
from bwbayes.app.running.folder import RunFolder
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError
from bwbayes.inference import map_estimate as pointfit, resolve_engine, stopwatch
from bwbayes.inference.posterior import Posterior
from bwbayes.inference.study import generator
from bwbayes.record import read_record, write_record
from tests.app import small
from tests.measured import keep

# Configs and records as accident and malice would write them.
# :func:`case` makes one from its number alone, so that any of them can be made again: a config and
# the record that it names, one of the two spoilt. Texts are spoilt by the byte, the token and the
# line; HDF5 and MATLAB files by the byte, and made again from arrays that belong in no record.


Generator = np.random.Generator

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
estimate_offset = true
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

# Texts in a token's place: numbers, names, notes, tables, and others.
WORDS = """\
nan -NaN inf 1e999 -1e999 1e308 1e-320 5e-324 -0 0 1 -1.5 1e9 -1e12 1_000 1,000 "1,000"
1.000,5 1;5 0x1F 1j 2147483648 9223372036854775808 ١٢٣ １２ ½ −1 1e +-1 --1 . true False None
=1+1 # '1' " ' a 1979-05-27T07:32:00Z <b>1</b> [/red] <script> time_ms TIME_S time time_V
voltage_kV voltage_um voltage_µV truth_um displacement_m displacement_nm _s time__s file signal
window prior fixed lower unit model truth seed d alpha mass sensor_sd training __class__
model_fields held-out ../x "record.csv" "none.csv" "/" "/dev/zero" "record.csv/x" "../.."
"step10" "white" "cauchy" "second-order" "auto" "<b>" [] {} [[]] [{}]
"""
ODD = (
    *WORDS.split(),
    *("", " ", "1\u200b", "\u00a01", "1\t2", "\0", "\x1b[31m1", "1\x0b", "1\x85", "1\u20282"),
    *("\ud7ff", "\u202ex", '"""', '"\\uD800"', '"\\u0000"', '"\\x"', "[1.0, 2.0]", "[[0.0, 0.2]]"),
    *("1" + "0" * 400, "9" * 5000, "0x" + "f" * 5000, "0." + "1" * 400, "a" * 5000, "x" * 200_000),
    *("[" * 3000, "[" * 3000 + "]" * 3000, "{a=" * 3000 + "1" + "}" * 3000, ".".join("a" * 3000)),
    *("{ distribution = 'normal' }", "{ distribution = 'normal', mean = 0.0, sd = 0.0 }"),
    *("{ distribution = 'lognormal', median = 1e-300, sigma = 1e3 }", "{ fixed = 1e300 }"),
    *("{ amplitude = 1e308, frequency = 1e-300, duration = 1e300 }", "{ window = [0.1, 0.3] }"),
    *("[[0.2, 0.1]]", "\n# voltage: comand\n", "\n# interval_s: nan\n", "\n# origin: [/red]\n"),
    *("\n[record]\n", "\n[[record]]\n", "\n[parameters.d.d]\n", "\n[validation.'a/../b']\n"),
)


class Case(NamedTuple):
    """A config and the record beside it; ``kind`` says which of the two was spoilt, and how."""

    kind: str
    config: bytes
    record: str
    data: bytes


def case(seed: int, number: int) -> Case:
    """Make the case of that number, always the same."""
    rng = np.random.default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    how, _, of = kind.partition(" of ")
    spoil = {"bytes": spoilt_bytes, "tokens": spoilt_tokens, "arrays": spoilt_arrays(of)}[how]
    if of == "config":
        config = spoil(chosen(rng, CONFIGS).encode(), rng)
        return Case(kind, config, "record.csv", made()["csv"])
    name = f"record.{of.split('-')[0]}"
    return Case(kind, QUICK.replace("record.csv", name).encode(), name, spoil(made()[of], rng))


KINDS = (
    *("tokens of csv", "tokens of config", "bytes of h5", "tokens of config", "bytes of mat"),
    *("arrays of h5", "bytes of config", "bytes of h5-other", "tokens of csv", "bytes of csv"),
    *("arrays of mat", "bytes of mat-7.3", "tokens of config", "bytes of mat-other"),
    "arrays of mat-7.3",
)


def chosen(rng: Generator, among: Any) -> Any:
    return among[int(rng.integers(len(among)))]


def few(rng: Generator) -> range:
    """Return how often to spoil one thing: once, mostly."""
    return range(int(rng.choice([1, 1, 1, 2, 4])))


def spoilt_bytes(good: bytes, rng: Generator) -> bytes:
    """Flip, change, drop, double, move, insert or blank bytes or stretches, or cut the end."""
    data = bytearray(good)
    for _ in few(rng):
        at, to = (int(place) for place in rng.integers(0, max(len(data), 1), 2))
        end = at + int(rng.choice([1, 1, 1, 4, 8, 100, 600]))
        match int(rng.integers(0, 9)):
            case 0 | 1 if data:
                data[at] ^= 1 << int(rng.integers(8))
            case 2:
                data[at:end] = rng.bytes(end - at)
            case 3:
                del data[at:end]
            case 4:
                data[at:at] = data[at:end]
            case 5:
                data[at:at] = rng.bytes(end - at)
            case 6:
                data[at:end] = chosen(rng, (b"\0", b"\xff", b"\x7f")) * (end - at)
            case 7 if rng.random() < 0.3:
                del data[at:]
            case 8:
                data[to : to + end - at] = data[at:end]
    return bytes(data)


def spoilt_tokens(good: bytes, rng: Generator) -> bytes:
    """Replace, scale, drop, double, reverse and insert tokens or lines, or change all of a sign."""
    text = good.decode()
    for _ in few(rng):
        pieces = re.split(chosen(rng, (r"(\n)", r"(\s+|[,=\[\]{}]+)", r"(\s+|[,=\[\]{}]+)")), text)
        at = int(rng.integers(len(pieces)))
        to = at + int(rng.choice([1, 2, 6, 40]))
        match int(rng.integers(0, 10)):
            case 0 | 1 | 2:
                pieces[at] = chosen(rng, ODD)
            case 3 | 4 if re.fullmatch(r"-?\d+(\.\d+)?", pieces[at]):
                factor = chosen(rng, (0.5, 2.0, 3.0, -1.0, 1e3, 1e-3, 1 + 1e-9))
                pieces[at] = repr(factor * float(pieces[at]))
            case 5:
                del pieces[at:to]
            case 6:
                pieces[at:at] = pieces[at:to]
            case 7:
                pieces[at:to] = pieces[at:to][::-1]
            case 8:
                pieces.insert(at, chosen(rng, ODD))
            case 9:
                signs = (
                    (",", ";"),
                    (".", ","),
                    (",", "\t"),
                    (",", " , "),
                    ("\n", "\r\n"),
                    ("\n", "\r"),
                )
                pieces = ["".join(pieces).replace(*chosen(rng, signs))]
        text = "".join(pieces)
    encoding: str = chosen(rng, ("utf-8",) * 8 + ("utf-16", "utf-8-sig"))
    return text.encode(encoding, errors="surrogatepass")


@cache
def made() -> dict[str, bytes]:
    """Return a good record in every format, as this package and as others write it."""
    files = {"csv": "\n".join([*GOOD, ""]).encode()}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        path.write_bytes(files["csv"])
        record = read_record(path)
        for kind, options in (("h5", {}), ("mat", {}), ("mat-7.3", {"mat_version": "7.3"})):
            path = path.with_suffix(f".{kind.split('-')[0]}")
            write_record(record, path, **options)  # type: ignore[arg-type]
            files[kind] = path.read_bytes()
    files["h5-other"] = stored(good_arrays() | {"@origin": "a bench"}, "h5")
    files["mat-other"] = stored(good_arrays(), "mat")
    return files


def good_arrays() -> dict[str, Any]:
    values = np.array([[float(cell) for cell in row.split(",")] for row in ROWS])
    return dict(zip(("time_s", "voltage_V", "displacement_um"), values.T, strict=True))


def stored(arrays: dict[str, Any], suffix: str) -> bytes:
    """Return the bytes of a file of arrays, made by h5py or SciPy alone."""
    buffer = BytesIO()
    if suffix == "mat":
        scipy.io.savemat(buffer, arrays)
        return buffer.getvalue()
    with h5py.File(buffer, "w", userblock_size=512 if suffix == "mat-7.3" else 0) as file:
        for name, values in arrays.items():
            if name.startswith("@"):
                file.attrs[name[1:]] = values
            elif callable(values):
                values(file, name)
            else:
                file[name] = values
    return buffer.getvalue()


def spoilt_arrays(suffix: str) -> Callable[[bytes, Generator], bytes]:
    """Return a maker of files in which an array or a note, or some, belong in no record."""

    def make(good: bytes, rng: Generator) -> bytes:
        del good
        arrays = good_arrays()
        for _ in few(rng):
            name, values = chosen(rng, [*arrays.items()])
            if suffix != "mat" and rng.random() < 0.3:
                arrays[name] = chosen(rng, ODD_OBJECTS)
            elif isinstance(values, np.ndarray) and values.dtype.kind in "iuf":
                with np.errstate(all="ignore"):
                    arrays[name] = chosen(rng, ODD_ARRAYS)(values, rng)
        if rng.random() < 0.3:
            note = chosen(rng, ("voltage_is", "origin", "interval_s"))
            odd = ("output", "x" * 999, "<b>[/red]\x1b", 1.0, np.nan, np.zeros(0), [[1, 2]])
            arrays[("@" if suffix == "h5" else "") + note] = chosen(rng, odd)
        return stored(arrays, suffix)

    return make


def _odd_value(values: Any, rng: Generator) -> Any:
    changed = np.array(values, dtype=np.float64)
    if changed.size:
        odd = (np.nan, np.inf, -np.inf, 1e300, -0.0, 5e-324, 1e10, 0.0)
        changed.flat[int(rng.integers(changed.size))] = chosen(rng, odd)
    return changed


ODD_ARRAYS: tuple[Callable[[Any, Generator], Any], ...] = (
    _odd_value,
    lambda values, _: values[:, np.newaxis] if values.ndim == 1 else values,
    lambda values, _: values[::-1],
    lambda values, rng: values[: chosen(rng, (0, 7))],
    lambda values, rng: np.resize(values, chosen(rng, ((4, 10), (2, 2, 10)))),
    lambda values, _: np.float64(values.flat[0] if values.size else 0),
    lambda values, rng: values.astype(chosen(rng, ("f4", "i1", "u8", ">f8", "c16", "?"))),
    lambda values, rng: values * chosen(rng, (1e-300, 1e300)),
    lambda values, _: np.full(values.shape, 3.0),
    lambda *_: "text instead",
)

# Objects that HDF5 can have in a dataset's place.
ODD_OBJECTS: tuple[Callable[[Any, str], Any], ...] = (
    lambda file, name: file.create_group(name),
    lambda file, name: file.__setitem__(name, h5py.SoftLink(f"/{name}")),
    lambda file, name: file.__setitem__(name, h5py.SoftLink("/nowhere")),
    lambda file, name: file.__setitem__(name, h5py.ExternalLink("/dev/zero", "/x")),
    lambda file, name: file.create_dataset(name, data=["a", "b"], dtype=h5py.string_dtype()),
    lambda file, name: file.create_dataset(name, data=np.zeros(40, [("a", "f8"), ("b", "i4")])),
    lambda file, name: file.create_dataset(name, data=h5py.Empty("f8")),
    lambda file, name: file.create_dataset(name, (40,), "f8", external=[("/dev/zero", 0, 320)]),
    lambda file, name: file.create_dataset(name, data=[file.ref] * 40, dtype=h5py.ref_dtype),
    lambda file, name: file.create_dataset(name, (10**13,), chunks=(1000,), dtype="f8"),
)


# Every case is checked in this process.

SEED = 1
FEW, ALL = 45, 10_000
SECONDS = 10  # of processor time, for a case that takes some hundredths
LONGEST_LINE = 700


class TooLate(BaseException):
    """The time of a case is over; no ``except Exception`` may take it for damage to a file."""


@dataclass(frozen=True)
class Said:
    """The command's output on a case, its exit status, and the processor time it took, s."""

    status: int
    out: str
    err: str
    seconds: float


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["bwbayes", "check", "my.toml"])
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


@pytest.fixture
def quick_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pointfit, "fit", best_draw)
    small.without_explanations(monkeypatch)
    monkeypatch.setattr(explaining, "explain", lambda *_, **__: ())
    monkeypatch.setattr(app_check, "save", lambda *_, **__: [])


def best_draw(
    posterior: Posterior, generator: np.random.Generator, *_: object
) -> pointfit.MAPEstimate:
    """Stand in for the point fit, with its error for priors that the record contradicts."""
    prior = posterior.prior
    draws = prior.unconstrain(prior.draw(generator, 64))
    density = posterior.log_density(draws)
    if not np.isfinite(density).any():
        raise InputError("priors: no draw has a finite posterior density; check priors and record")
    best, spread = draws[np.argmax(density)], np.atleast_2d(np.cov(draws, rowvar=False))
    return pointfit.MAPEstimate(best, spread, float(density.max()), best[np.newaxis], spread)


def check(one: Case, place: Path, seconds: int = SECONDS) -> Said:
    """Type ``bwbayes check my.toml`` with the files of a case; a defect keeps its traceback."""
    (place / "my.toml").write_bytes(one.config)
    (place / one.record).write_bytes(one.data)
    out, err, status = io.StringIO(), io.StringIO(), None
    begun = time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), limited(seconds):
        try:
            cli.main()
        except SystemExit as end:
            status = end.code
    assert isinstance(status, int)
    said = small.without_progress(err.getvalue())
    return Said(status, out.getvalue(), said, time.process_time() - begun)


@contextlib.contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Raise after some seconds, and end the process if it hangs where Python cannot raise.

    Compilation, which later cases use too, is not counted.
    """

    def late(*_: object) -> None:
        if clock() >= seconds:
            raise TooLate
        signal.setitimer(signal.ITIMER_PROF, max(seconds - clock(), 0.1))

    before = signal.signal(signal.SIGPROF, late), signal.getsignal(signal.SIGTERM)
    faulthandler.dump_traceback_later(30 * seconds, exit=True, file=sys.__stderr__ or 2)
    try:
        with stopwatch(resolve_engine()) as clock:
            signal.setitimer(signal.ITIMER_PROF, seconds)
            yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGPROF, before[0])
        signal.signal(signal.SIGTERM, before[1])


def assert_used_or_refused(one: Case, said: Said, place: Path) -> None:
    assert {"my.toml", one.record} == {path.name for path in place.iterdir()}
    if said.status == 2:
        assert said.out == ""
        assert said.err.startswith("bwbayes: ")
        assert said.err.endswith("\n")
        assert said.err[:-1].isprintable()
        assert len(said.err) <= LONGEST_LINE
        assert "out of memory" not in said.err
    else:
        assert (0, "") == (said.status, said.err)
        assert "MAP estimate" in said.out
        assert_becomes_a_run(place)


def assert_becomes_a_run(place: Path) -> None:
    """Make the run's folder, and find the same numbers in it and nothing beside it."""
    problem = resolve_config(load(place / "my.toml"), place)
    before = {path.name for path in place.iterdir()}
    folder = RunFolder.create(place / "out", problem, overwrite=False)
    assert before | {"out"} == {path.name for path in place.iterdir()}
    again = Run(folder)
    assert again.config == problem.config
    assert again.study.record.sha256 == problem.study.record.sha256
    prior = problem.study.posterior.prior
    coordinates = prior.unconstrain(prior.draw(generator(1, "hostile"), 8))
    np.testing.assert_array_equal(
        problem.study.posterior.log_density(coordinates),
        again.study.posterior.log_density(coordinates),
    )
    free, _ = prior.constrain(coordinates)
    assert np.isfinite(problem.study.posterior.simulate(prior.theta(free))).all()
    shutil.rmtree(folder.path)


def spoilt(numbers: range, place: Path) -> dict[str, Counter[int]]:
    """Check the cases of these numbers; return how often each kind ended with each status."""
    result = {kind: Counter[int]() for kind in KINDS}
    slowest = (0.0, "")
    # Without a limit what is compiled is compiled now.
    assert check(Case("good", QUICK.encode(), "record.csv", made()["csv"]), place, 600).status == 0
    (place / "record.csv").unlink()
    for number in numbers:
        one = case(SEED, number)
        try:
            said = check(one, place)
            assert_used_or_refused(one, said, place)
        except BaseException as error:
            error.add_note(f"case({SEED}, {number}): {one.kind}")
            raise
        slowest = max(slowest, (said.seconds, f"case({SEED}, {number}), {one.kind}"))
        result[one.kind][said.status] += 1
        (place / one.record).unlink()
    print(f"slowest: {slowest[0]:.2f} s, {slowest[1]}")
    for kind, counts in result.items():
        print(f"{kind}: {counts[0]} used, {counts[2]} refused")
    return result


@pytest.mark.usefixtures("quick_fit")
def test_spoilt_inputs_are_used_or_refused_in_one_line(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(explaining, "chosen_noise", lambda *_: ("discrepancy", ""))
    result = spoilt(range(FEW), place)
    assert sum(counts[0] for counts in result.values()) > 0.1 * FEW, "hardly any is used"
    for kind, counts in result.items():
        assert counts[2] > 0, f"{kind}: nothing was refused"


@pytest.mark.slow
@pytest.mark.usefixtures("quick_fit")
def test_ten_thousand_spoilt_inputs_are_used_or_refused_in_one_line(place: Path) -> None:
    result = spoilt(range(ALL), place)
    used, refused = (sum(counts[status] for counts in result.values()) for status in (0, 2))
    keep("hostile input", {"used": used, "refused": refused})
    assert ALL == sum(counts.total() for counts in result.values())

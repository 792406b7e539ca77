"""Files from strangers run no code, leave no folder, and put nothing of theirs into the page."""

import contextlib
import dataclasses
import io
import os
import pickle
import sys
import warnings
import zipfile
from collections.abc import Callable
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bwbayes.app.config.config import parse
from bwbayes.errors import InputError, InputWarning
from bwbayes.inference.parameters import JointPrior
from bwbayes.record import Record, read_record, write_record
from bwbayes.report.report import Report, as_text
from bwbayes.report.result import Result
from bwbayes.report.run import priors_table
from bwbayes.sampling.chain import ChainFile
from tests.app import example
from tests.app.test_hostile_input import QUICK, good_arrays, stored
from tests.sampling.chains import finish, new


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return os.mkdir, (str(self.mark),)


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    return tmp_path / "the payload ran"


@pytest.fixture
def payload(mark: Path) -> bytes:
    return pickle.dumps(Payload(mark))


def test_the_payload_is_live(payload: bytes, mark: Path) -> None:
    pickle.loads(payload)
    assert mark.exists()


def as_numpy_file(payload: bytes) -> bytes:
    buffer = io.BytesIO()
    header = {"descr": "|O", "fortran_order": False, "shape": (40,)}
    np.lib.format.write_array_header_1_0(buffer, header)
    return buffer.getvalue() + payload


def among(suffix: str, *names: str, value: Callable[[bytes], Any]) -> Callable[[bytes], bytes]:
    """Return a maker of files with the payload in the place of arrays, or as notes (``@``)."""
    return lambda payload: stored(good_arrays() | dict.fromkeys(names, value(payload)), suffix)


def marked(payload: bytes) -> Callable[[Any, str], None]:
    """Return a maker of a dataset that is marked as PyTables and pandas mark what they pickle."""

    def make(file: Any, name: str) -> None:
        file[name] = good_arrays()[name]
        file[name].attrs["PSEUDOATOM"] = "object"
        file[name].attrs["h5py_pickle"] = np.void(payload)

    return make


def numbers(payload: bytes) -> Any:
    return np.frombuffer(payload, dtype=np.uint8)


def of_class(code: int) -> Callable[[bytes], bytes]:
    """Return a maker of MATLAB files whose voltage says that it is an object, or opaque."""

    def make(payload: bytes) -> bytes:
        data = bytearray(among("mat", "voltage_V", value=numbers)(payload))
        flags = data.index(b"voltage_V") - 8 - 16 - 8
        assert data[flags] == 9  # uint8
        data[flags] = code
        return bytes(data)

    return make


# Where libraries have taken pickles from.
PLANTS: dict[str, tuple[str, Callable[[bytes], bytes]]] = {
    "pickle as csv": ("csv", bytes),
    "npy as h5": ("h5", as_numpy_file),
    "note in h5": ("h5", among("h5", "@origin", "@voltage_is", value=np.void)),
    "attribute in h5": ("h5", among("h5", "voltage_V", value=marked)),
    "object in mat": ("mat", of_class(3)),
    "opaque in mat": ("mat", of_class(17)),
}


@pytest.mark.parametrize("plant", PLANTS)
def test_a_pickle_in_a_record_is_refused_or_inert(
    tmp_path: Path, payload: bytes, mark: Path, plant: str
) -> None:
    suffix, make = PLANTS[plant]
    path = tmp_path / f"record.{suffix}"
    path.write_bytes(make(payload))
    if plant == "attribute in h5":
        np.testing.assert_array_equal(good_arrays()["voltage_V"], read_record(path).voltage)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)  # an object may be named before
            with pytest.raises(InputError):
                read_record(path)
    assert not mark.exists()


@pytest.mark.parametrize("place", ["start", "sampling-0002"])
@pytest.mark.parametrize("whole", [True, False], ids=["the file", "an array"])
def test_a_pickle_in_a_chain_is_refused_or_inert(
    tmp_path: Path, payload: bytes, mark: Path, place: str, whole: bool
) -> None:
    chain = new(tmp_path / "chain")
    finish(chain)
    file = chain.path / f"{place}.npz"
    if whole:
        file.write_bytes(payload)
    else:
        with zipfile.ZipFile(file, "w") as archive:
            for name in ("text", "weights", "coordinates"):
                header = np.lib.format.header_data_from_array_1_0(np.array([None]))
                content = BytesIO()
                np.lib.format.write_array_header_1_0(content, header)
                archive.writestr(f"{name}.npy", content.getvalue() + payload)
    for open_chain in (ChainFile.read, ChainFile.resume):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            with contextlib.suppress(InputError):
                open_chain(chain.path)
    assert not mark.exists()


def test_a_run_loads_no_code_while_it_reads(tmp_path: Path) -> None:
    """Audit events of Python for pickles, compiled code and other programs."""
    events: list[str] = []
    listening = [True]
    # NumPy parses the header of an array, a literal; what is compiled so is not run.
    watched = ("pickle.find_class", "exec", "marshal.loads", "subprocess.Popen")

    def hook(event: str, _: tuple[object, ...]) -> None:
        if listening[0] and event.startswith((*watched, "os.system", "os.exec", "ctypes.dlopen")):
            events.append(event)

    record = Record(np.arange(40.0), np.arange(40.0) ** 2, interval=0.01)
    paths = [tmp_path / name for name in ("record.csv", "record.h5", "record.mat")]
    for path in paths:
        write_record(record, path)
        read_record(path)  # libraries load the rest of themselves now
    finish(new(tmp_path / "chain"))
    ChainFile.read(tmp_path / "chain")
    sys.addaudithook(hook)
    try:
        for path in paths:
            read_record(path)
        ChainFile.read(tmp_path / "chain")
        assert [] == events
        pickle.loads(pickle.dumps(Path()))
        assert "pickle.find_class" in events
    finally:
        listening[0] = False


PAYLOADS = (
    "<script>alert(1)</script>",
    "</title><img src=x onerror=alert(1)>",
    "\"'><svg/onload=alert(1)>",
    "--></style></table><iframe src='javascript:alert(1)'>",
    "{{ 1234 * 5678 }}{% include 'report.html.j2' %}",
    "&lt;b&gt;&#60;i&#62;",
    "<x\N{NULL}y \N{RIGHT-TO-LEFT OVERRIDE}>",
    "$\\frac{1$ [/red] \\",
)


class Skeleton(HTMLParser):
    """The tags of a page with their attributes' names, and nothing else."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, ...]] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: D102
        self.tags.append((tag, *(name for name, _ in attrs)))

    def handle_endtag(self, tag: str) -> None:  # noqa: D102
        self.tags.append((f"/{tag}",))

    def handle_comment(self, data: str) -> None:  # noqa: D102
        self.tags.append(("comment", data))


def page(text: str, converged: bool) -> str:
    label = "".join(f"\\U{ord(character):08X}" for character in text)
    config = parse(QUICK + f'[parameters.d]\nfixed = 1.0\nlabel = "{label}"\n', "my.toml")
    odd = [
        dataclasses.replace(
            p, unit=text, label=config.parameters["d"].label or "", description=text
        )
        for p in example.PARAMETERS
    ]
    run: Result = example.run(converged, parameters=tuple(odd))
    origin = Record(np.arange(20.0), None, interval=1.0, origin=text).origin
    run = dataclasses.replace(
        run, name=text, remarks=(text,), facts={"record": origin, "drive": text, "config": text}
    )
    return example.page(run, pictures={"trace": b"png"})


@pytest.mark.parametrize(
    ("text", "converged"), [*((text, False) for text in PAYLOADS), (" ".join(PAYLOADS), True)]
)
def test_texts_add_no_tag_to_the_page(text: str, converged: bool) -> None:
    """Each where the page is short, and all of them in each place of a page with plots."""
    harmless, shown = (page(words, converged) for words in ("harmless", text))
    # A symbol that is no letter is shown by its name, which has no subscript either.
    assert Skeleton(harmless).tags == Skeleton(shown).tags
    assert "7006652" not in shown


@pytest.mark.parametrize("text", PAYLOADS)
def test_texts_on_the_screen_are_what_they_are(text: str) -> None:
    parameters = [dataclasses.replace(p, unit=text) for p in example.PARAMETERS]
    report = Report(title="", blocks=[priors_table(JointPrior(parameters))])
    # A long one may go on in the next line.
    shown = " ".join(as_text(report, width=500).split())
    assert " ".join(text.partition("\0")[0].split()) in shown


@pytest.mark.parametrize(
    "name",
    ["..", ".", "", "../up", "a/b", "/tmp/x", "a\\\\b", "a.b", "a\\u0000", "a\\n", "é", "x" * 101],
)
def test_a_validation_may_not_be_called_like_a_path(name: str) -> None:
    with pytest.raises(InputError):
        parse(f'{QUICK}[validation."{name}"]\nwindow = [0.1, 0.2]\n', "my.toml")

"""What the environment lacks ends in no traceback: encodings, readers, processes, caches."""

import os
import re
import shutil
import subprocess
import sys
import warnings
from itertools import product
from pathlib import Path

import pytest

import bwbayes as bw
from bwbayes.app.running.folder import RunFolder
from bwbayes.errors import InputError, InputWarning
from tests.app import small


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )


MU = "\N{GREEK SMALL LETTER MU}"


@pytest.mark.parametrize(
    ("encoding", "commands"),
    [
        ("gbk", [["models"]]),
        ("ascii", [["models"], ["run", MU]]),
    ],
)
def test_text_goes_to_a_stream_of_any_encoding(encoding: str, commands: list[list[str]]) -> None:
    for arguments in commands:
        ended = python("-m", "bwbayes", *arguments, PYTHONIOENCODING=encoding)
        assert ended.returncode == (2 if arguments[-1] == MU else 0)
        assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("stream", ["| true", ">&-"])
def test_a_reader_that_has_gone_is_no_error(stream: str) -> None:
    command = f"{sys.executable} -m bwbayes models {stream}"
    ended = subprocess.run(["sh", "-c", command], capture_output=True, check=False)
    assert ended.stderr == b""


@pytest.mark.parametrize("command", [["models"], ["export", "copy", "--quiet"]])
def test_what_nobody_reads_ends_as_a_broken_pipe_does(copy: RunFolder, command: list[str]) -> None:
    """With 128 + SIGPIPE and no word; what prints nothing comes to its own end."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write) as closed:
        ended = subprocess.run(
            [sys.executable, "-m", "bwbayes", *command],
            cwd=copy.path.parent, stdout=closed, stderr=subprocess.PIPE, check=False,
        )  # fmt: skip
    assert ended.returncode == (0 if "--quiet" in command else 141)
    assert ended.stderr == b""


@pytest.mark.usefixtures("_without_pictures", "_without_explanations")
def test_a_run_behind_head_is_resumed(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(small.TEXT)
    (tmp_path / "unexplained.py").write_text(small.UNEXPLAINED)
    command = f"{sys.executable} unexplained.py run small.toml --out run --workers 1 | head -n 1"
    ended = subprocess.run(
        ["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "rror" not in ended.stderr
    assert len(ended.stdout.splitlines()) == 1
    assert bw.resume(tmp_path / "run", progress=False).converged


def test_numba_may_be_switched_off() -> None:
    script = "from bwbayes.inference.engine import resolve_engine; print(resolve_engine())"
    assert python("-c", script, NUMBA_DISABLE_JIT="1").stdout == "numpy\n"
    script = script.replace("resolve_engine()", "resolve_engine('numba')")
    assert "NUMBA_DISABLE_JIT is set" in python("-c", script, NUMBA_DISABLE_JIT="1").stderr


def test_without_a_place_for_a_cache_functions_are_compiled_all_the_same() -> None:
    script = """
import numba.core.caching as caching
for locator in caching.CacheImpl._locator_classes:
    locator.from_function = classmethod(lambda *_: None)
from bwbayes.inference.compiled.caching import compile_cached
for number in range(2):
    assert compile_cached()(lambda x: x + 1)(number) == number + 1
"""
    ended = python("-c", script)
    assert ended.returncode == 0, ended.stderr
    assert "no cache can be written" in ended.stderr


OUTER = """
from bwbayes.inference.compiled.caching import compile_cached
from bwbayes.model.inner import inner

@compile_cached()
def outer():
    return inner()
"""
INNER = """
from bwbayes.inference.compiled.caching import compile_cached

@compile_cached()
def inner():
    return {}
"""


def test_what_is_compiled_of_other_sources_is_not_taken(tmp_path: Path) -> None:
    """What is called has changed alone, which numba does not look at; else the cache is taken."""
    package = tmp_path / "bwbayes"
    shutil.copytree(Path(bw.__file__).parent, package, ignore=shutil.ignore_patterns("*cache*__"))
    (package / "inference" / "compiled" / "outer.py").write_text(OUTER)
    (tmp_path / "script.py").write_text("""
from bwbayes.inference.compiled.outer import outer
print(outer(), sum(outer.stats.cache_hits.values()))
""")
    for value, hits in ((1, 0), (1, 1), (20, 0)):
        (package / "model" / "inner.py").write_text(INNER.format(value))
        ended = python(str(tmp_path / "script.py"))
        assert ended.stdout == f"{value} {hits}\n", ended.stderr


WORK = """
from bwbayes.app.running.workers import open_executor
{broken}
with open_executor(2) as pool:
    print(pool.submit(abs, -3).result())
"""
NO_SEMAPHORES = """
import multiprocessing.synchronize
def refuse(*_, **__):
    raise OSError(38, "Function not implemented")
multiprocessing.synchronize.SemLock.__init__ = refuse
"""


@pytest.mark.parametrize("broken", ["", NO_SEMAPHORES])
def test_where_no_process_starts_this_one_computes(tmp_path: Path, broken: str) -> None:
    script = tmp_path / "script.py"
    script.write_text(WORK.format(broken=broken))
    ended = python(str(script))
    assert (ended.returncode, ended.stdout) == (0, "3\n"), ended.stderr
    assert ended.stderr.count("no worker process starts") == 1
    assert "Traceback" not in ended.stderr


@pytest.mark.usefixtures("_without_pictures", "_without_explanations")
@pytest.mark.parametrize(
    ("file", "share"),
    [
        *product(["result.npz", "chain.h5", "posterior.nc"], [0.0, 0.5]),
        *product(["chain/start.npz", "chain/sampling-0001.npz"], [0.5]),
        pytest.param("chain/start.npz", 0.0, marks=pytest.mark.slow),
        pytest.param("chain/sampling-0001.npz", 0.0, marks=pytest.mark.slow),
    ],
)
def test_a_run_of_which_a_file_is_cut_off_is_resumed_to_its_end(
    copy: RunFolder, file: str, share: float
) -> None:
    whole = (copy.path / file).read_bytes()
    (copy.path / file).write_bytes(whole[: int(share * len(whole))])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # the chain is damaged
        if file == "chain/start.npz":
            with pytest.raises(InputError, match=r"chain cannot be read .*; delete it"):
                bw.resume(copy.path, progress=False)
            shutil.rmtree(copy.chain)
        assert bw.resume(copy.path, progress=False).converged
    assert copy.numbers()


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("file", ["records/record.h5", "config.toml"])
def test_what_a_run_is_about_is_not_made_up(copy: RunFolder, file: str, share: float) -> None:
    whole = (copy.path / file).read_bytes()
    (copy.path / file).write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=re.escape(str(copy.path / file))):
        bw.resume(copy.path, progress=False)


@pytest.mark.parametrize("text", ["", "{", '{"a": 1', "[]", "\0"])
def test_a_summary_that_is_cut_off_is_not_finished(tmp_path: Path, text: str) -> None:
    folder = RunFolder(tmp_path)
    folder.summary.write_text(text)
    with pytest.raises(InputError, match="is not finished; resume with"):
        folder.require_finished()

"""Processes that start in milliseconds: from a server that has all imported already.

There is one such server for all tests of a process, so what it imports is decided here.
"""

import multiprocessing

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    ["pytest", "bwbayes.app.commands.cli", "bwbayes.app.running.run", "tests.app.small"]
)

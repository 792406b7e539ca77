"""Benchmarks: what a sample costs, how fast effective draws come, how long a person waits.

    python -m tests.benchmarks              # all of it, as tables on the screen
    python -m tests.benchmarks --quick      # fewer rounds
    python -m tests.benchmarks waits --against ../before    # what a person waits for
    python -m tests.benchmarks campaigns    # a campaign of a thousand short records

Timings depend on the machine and on what else it does; no test passes or fails by them.
"""

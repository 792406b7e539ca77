"""Tests of bwbayes.sampling: ensembles, chains in memory and on disk, convergence."""

"""Sampling of a posterior: ensembles of walkers, the chain on disk, convergence."""

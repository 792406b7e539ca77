"""From a posterior to its draws: ensembles of walkers, the chain on disk, convergence."""

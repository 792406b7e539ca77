"""From a record to a posterior: parameters, noise, point fit, sampling, convergence."""

"""From a config to a problem: record, model, parameters and priors, ready to be fitted."""

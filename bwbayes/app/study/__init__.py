"""From a config to a run: its records, model, parameters and priors."""

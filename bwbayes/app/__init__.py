"""The user's side: config, command line, figures and report."""

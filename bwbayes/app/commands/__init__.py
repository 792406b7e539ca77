"""The command line: a module for each job, and the thin layer of options over them."""

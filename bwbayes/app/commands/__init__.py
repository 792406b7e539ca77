"""The command line: a module for each command, which reads options and calls its job."""

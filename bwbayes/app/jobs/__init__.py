"""Jobs behind the commands, for Python and the command line alike: one module each."""

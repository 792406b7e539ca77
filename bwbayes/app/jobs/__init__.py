"""What each command does, for Python and the command line alike: a module for each job."""

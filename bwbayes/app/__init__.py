"""What a user touches: the config, the command line, the pictures and the report."""

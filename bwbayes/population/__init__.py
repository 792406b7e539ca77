"""Populations of specimens of one kind of actuator: distribution, outliers, the next specimen."""

"""What many specimens of one kind of actuator say together: population, outliers, the next one."""

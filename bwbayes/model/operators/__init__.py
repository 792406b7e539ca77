"""Hysteresis operators, one in each file: what a voltage's path does to a displacement."""

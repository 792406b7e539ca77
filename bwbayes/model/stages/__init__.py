"""Stages before and behind the hysteresis, one in each file."""

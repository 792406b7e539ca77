"""Tests of the hysteresis operators, each against a slow and obvious one."""

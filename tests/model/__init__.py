"""Tests of the hysteresis, the linear dynamics and the actuator made of both."""

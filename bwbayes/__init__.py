"""Bayesian uncertainty of piezoelectric actuators with the Bouc-Wen hysteresis model."""

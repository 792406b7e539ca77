"""Simulation-based calibration: whether posteriors and bands are what they say."""

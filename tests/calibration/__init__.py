"""Tests of bwbayes.calibration."""

"""Tests of records, signals and the virtual test stand."""

"""Tests of what puts a fitted model to work."""

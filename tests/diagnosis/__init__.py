"""Tests of what is said to be wrong, and why."""

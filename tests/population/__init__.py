"""Tests of what specimens say of their population."""

"""Tests of the model that is read backwards."""

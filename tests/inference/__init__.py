"""Tests of the way from a record to a posterior."""

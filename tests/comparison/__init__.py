"""Tests of bwbayes.comparison: which model, and what can be told apart."""

"""Tests of bwbayes.report."""

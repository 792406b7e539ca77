"""Tests of bwbayes.results: predictions and how they are judged."""

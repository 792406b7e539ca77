"""Tests of bwbayes.prediction: predictions and how they are judged."""

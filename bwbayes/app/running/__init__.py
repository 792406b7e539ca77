"""A run and its folder: progress, workers, predictions, and going on after an interruption."""

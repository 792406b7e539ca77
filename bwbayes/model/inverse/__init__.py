"""The model read backwards: from a displacement that is asked for to the voltage that gives it."""

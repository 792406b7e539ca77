"""Models compared: what each was worth on data it had not seen, and what that can tell apart."""

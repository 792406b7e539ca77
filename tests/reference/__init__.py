"""Posteriors made once by an independent route, and that route."""

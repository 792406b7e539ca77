"""Diagnosis: what is wrong with a record, a fit or its bands, and what to do about it."""

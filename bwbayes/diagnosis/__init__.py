"""Diagnosis of a record, a fit or its bands: defects and their fixes."""

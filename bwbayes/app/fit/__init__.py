"""A fit as Python users have it: one call, one object, its figures."""

"""What can go wrong for a user, and how it is said: in one line.

An error that a person can mend (a broken record, a misspelt key, a parameter outside its domain)
is an :class:`InputError`; its text says where, what, and what to do. The command line prints that
line and ends with status 2. Anything else is a defect of bwbayes and keeps its traceback.
"""

from __future__ import annotations

__all__ = ["InputError", "InputWarning"]


class InputError(ValueError):
    """Input that cannot be used; the text is one line: where, what, and what to do."""


class InputWarning(UserWarning):
    """Input that can be used, with something about it that the user should know."""

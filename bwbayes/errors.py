"""What can go wrong for a user, and how it is said: in one line.

An error that a person can mend (a broken record, a misspelt key, a parameter outside its domain)
is an :class:`InputError`; its text says where, what, and what to do. The command line prints that
line and ends with status 2. Anything else is a defect of bwbayes and keeps its traceback.
"""

from __future__ import annotations

__all__ = ["InputError", "InputWarning", "one_line"]

# Of a longer text, as a stranger's file may cause, the beginning and the end are shown.
LONGEST = 600


class InputError(ValueError):
    """Input that cannot be used; the text is one line: where, what, and what to do."""

    def __init__(self, text: str) -> None:
        line = one_line(text)
        if len(line) > LONGEST:
            line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 3 :]}"
        super().__init__(line)


def one_line(text: str) -> str:
    """Return a text with blanks for line breaks and all else that does not print."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


class InputWarning(UserWarning):
    """Input that can be used, with something about it that the user should know."""

"""What an error says to do, in the words of the command line.

Errors speak to those who call the package from Python, of arguments and functions in backticks:
``overwrite=True``, ``bwbayes.resume("results/a", steps=100)``. On the command line the same
are ``--overwrite`` and ``bwbayes resume results/a --steps 100``.
"""

from __future__ import annotations

import ast
import re

__all__ = ["as_typed"]

# Functions and arguments that are called otherwise there.
COMMANDS = {"bwbayes.fit": "bwbayes run", "bwbayes.resume": "bwbayes resume"}
OPTIONS = {"folder": "out"}


def as_typed(text: str) -> str:
    """Return a text with what is in backticks, arguments and calls, as it is typed in a shell."""
    return re.sub(r"`([^`]*)`", lambda match: f"`{_typed(match[1])}`", text)


def _typed(code: str) -> str:
    """Return a call or a keyword argument as a command or an option; all else as it is."""
    is_call = any(code.startswith(f"{name}(") for name in COMMANDS)
    try:
        call = ast.parse(code if is_call else f"_({code})", mode="eval").body
    except (SyntaxError, ValueError):
        return code
    # TOML has blanks about the sign.
    if not isinstance(call, ast.Call) or not (is_call or (call.keywords and " = " not in code)):
        return code
    words = [COMMANDS[ast.unparse(call.func)]] if is_call else []
    words += [_value(argument) for argument in call.args]
    for keyword in call.keywords:
        name = str(keyword.arg)
        words.append(f"--{OPTIONS.get(name, name).replace('_', '-')}")
        words += [] if _value(keyword.value) == "True" else [_value(keyword.value)]
    return " ".join(words)


def _value(node: ast.expr) -> str:
    return str(node.value) if isinstance(node, ast.Constant) else ast.unparse(node)

"""Keyword arguments that a method takes over from the function that uses them.

A method that is a thin layer over a function names the function once, and has its keyword
arguments: in its signature, in its docstring, and in the error that an unknown one causes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from functools import wraps
from inspect import Parameter, getdoc, signature
from textwrap import indent
from typing import Any, TypeVar

from bwbayes.errors import InputError, suggestion

__all__ = ["options_of"]

F = TypeVar("F", bound=Callable[..., Any])

# Where the options are described in a method's docstring.
PLACE = "{options}"


def options_of(source: Callable[..., Any]) -> Callable[[F], F]:
    """Give a method the keyword arguments of a function or class, in place of its ``**options``.

    In the method's docstring ``{options}`` stands where they are described. An argument that is
    unknown is refused in one line, an :class:`~bwbayes.errors.InputError`.
    """
    options = {
        name: parameter
        for name, parameter in signature(source).parameters.items()
        if parameter.kind is Parameter.KEYWORD_ONLY
    }

    def decorate(method: F) -> F:
        positional = {
            name: parameter
            for name, parameter in signature(method).parameters.items()
            if parameter.kind is not Parameter.VAR_KEYWORD
        }

        @wraps(method)
        def checked(*given: Any, **keywords: Any) -> Any:
            for name in keywords:
                if name not in options and name not in positional:
                    raise InputError(
                        f"{method.__name__}: {name} is unknown; {suggestion(name, options)}"
                    )
            return method(*given, **keywords)

        parameters = [*positional.values(), *options.values()]
        shown: Any = checked
        shown.__signature__ = signature(method).replace(parameters=parameters)
        shown.__doc__ = _with_options(method.__doc__ or "", source, options)
        result: F = shown
        return result

    return decorate


def _with_options(text: str, source: Callable[..., Any], names: Collection[str]) -> str:
    """Return a docstring with the descriptions of a function's arguments of some names."""
    place = re.search(rf"^( *){re.escape(PLACE)}", text, re.MULTILINE)
    assert place is not None
    _, _, parameters = (getdoc(source) or "").partition("Parameters\n----------\n")
    parameters = re.split(r"\n\n\w+\n-+\n", parameters)[0]
    entries = re.split(r"\n(?=\S)", parameters.rstrip())
    chosen = [entry for entry in entries if re.split(r"[,\s]", entry)[0] in names]
    return text.replace(place[0], indent("\n".join(chosen), place[1]))

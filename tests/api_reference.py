"""The API reference, built from the docstrings: ``python -m tests.api_reference FOLDER``.

Needs the extra ``docs``. A warning of pdoc's is an error: a name that does not resolve, a default
that cannot be shown, a module that does not import.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from types import FunctionType, ModuleType
from typing import get_type_hints

import bwbayes


def build(folder: Path) -> None:
    """Write the pages to a folder, ``bwbayes.html`` first."""
    import pdoc  # noqa: PLC0415  # an extra, which those who only run the tests may lack

    # pdoc looks at what there is in a module, and public names are loaded when first used.
    for name in bwbayes.__all__:
        setattr(bwbayes, name, getattr(bwbayes, name))
    for module in every_module():
        _resolve(module)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pdoc.render.configure(docformat="numpy")
        # pdoc takes a package's __all__ for all that is in it: other modules are named to it.
        asked = ["bwbayes"]
        for module in every_module():
            if module.__name__ not in pdoc.extract.walk_specs(asked):
                asked.append(module.__name__)
        pdoc.pdoc(*asked, output_directory=folder)
    for page in (*folder.rglob("*.html"), folder / "search.js"):
        # Sphinx hides the path of a name behind a tilde; here the link is enough.
        text = page.read_text(encoding="utf-8")
        page.write_text(text.replace("<code>~", "<code>"), encoding="utf-8")


def every_module() -> Iterator[ModuleType]:
    """Import all modules of the package."""
    for one in walk_packages(bwbayes.__path__, "bwbayes."):
        yield import_module(one.name)


def _resolve(module: ModuleType) -> None:
    """Put types for the annotations that pdoc cannot read.

    These are of named tuples, whose constructors know no module, of fields that are inherited from
    another module, and of generic functions and methods.
    """
    for one in list(vars(module).values()):
        if getattr(one, "__module__", "") != module.__name__:
            continue
        if isinstance(one, type) and issubclass(one, tuple):
            one.__new__.__annotations__ = get_type_hints(one)
        elif isinstance(one, type) and is_dataclass(one):
            hints, made = get_type_hints(one), one.__init__
            made.__annotations__ = {n: hints.get(n, a) for n, a in made.__annotations__.items()}
        for function in (one, *(vars(one).values() if isinstance(one, type) else ())):
            if isinstance(function, FunctionType) and function.__type_params__:
                names = {parameter.__name__: parameter for parameter in function.__type_params__}
                function.__annotations__ = get_type_hints(function, localns=names)


if __name__ == "__main__":
    build(Path(sys.argv[1]))

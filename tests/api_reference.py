"""The API reference, built from the docstrings: ``python -m tests.api_reference FOLDER``.

Needs the extra ``docs``.
"""

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from types import ModuleType

import bwbayes


def build(folder: Path) -> None:
    """Write the pages to a folder, ``bwbayes.html`` first."""
    import pdoc  # noqa: PLC0415  # an extra, which those who only run the tests may lack

    # pdoc looks at what there is in a module, and public names are loaded when first used.
    for name in bwbayes.__all__:
        setattr(bwbayes, name, getattr(bwbayes, name))
    pdoc.render.configure(docformat="numpy")
    # pdoc takes a package's __all__ for all that is in it: other modules are named to it.
    asked = ["bwbayes"]
    for module in every_module():
        if module.__name__ not in pdoc.extract.walk_specs(asked):
            asked.append(module.__name__)
    pdoc.pdoc(*asked, output_directory=folder)


def every_module() -> Iterator[ModuleType]:
    for module in walk_packages(bwbayes.__path__, "bwbayes."):
        yield import_module(module.name)


if __name__ == "__main__":
    build(Path(sys.argv[1]))

"""The reference: a page for every module, made of the docstrings of all its public names.

    python experiments/reference.py        # or: make docs

writes build/docs/index.html. Arguments: another folder, and modules to document instead of all.
"""

import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from pdoc import doc, render

import jaxpend
from jaxpend.files import write_atomically

OUT = Path(__file__).parent.parent / "build" / "docs"


def module_names() -> list[str]:
    """All modules of the package, without those that are commands."""
    found = [module.name for module in pkgutil.walk_packages(jaxpend.__path__, "jaxpend.")]
    return ["jaxpend", *(name for name in found if not name.endswith("__main__"))]


def describe(known: doc.Class) -> None:
    """Give the fields of a dataclass the comments beside them: shapes and units are there."""
    beside = r"^    (\w+): [^#\n]*?(?:  # (.+))$"
    comments = dict(re.findall(beside, inspect.getsource(known.obj), re.MULTILINE))
    for name, comment in comments.items():
        if name in known.members:
            known.members[name].docstring = comment


def main(folder: Path = OUT, names: Sequence[str] = ()) -> None:
    """Write the pages."""
    names = list(names) or module_names()
    for name in jaxpend.__all__:
        getattr(jaxpend, name)  # they are imported when they are first asked for
    modules = {name: doc.Module(importlib.import_module(name)) for name in names}
    for name, module in modules.items():
        inside = [n for n in names if n.startswith(f"{name}.") and "." not in n[len(name) + 1 :]]
        module.submodules = [modules[n] for n in inside]
        for known in module.classes:
            describe(known)
    render.configure(docformat="google", footer_text=f"jaxpend {jaxpend.__version__}")
    for name, module in modules.items():
        page = folder / f"{name.replace('.', '/')}.html"
        write_atomically(page, render.html_module(module, modules))
    write_atomically(folder / "index.html", render.html_index(modules))
    write_atomically(folder / "search.js", render.search_index(modules))
    print(f"the reference is {folder / 'index.html'}", file=sys.stderr)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]), names=sys.argv[2:])

"""The reference: a page for every module, made of the docstrings of all its public names.

    python experiments/reference.py        # or: make docs

writes build/docs/index.html. Arguments: another folder, and modules to document instead of all.
"""

import importlib
import inspect
import pkgutil
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

from pdoc import doc, render

import jaxpend
from jaxpend.files import write_atomically

OUT = Path(__file__).parent.parent / "build" / "docs"
# Where jax.Array is defined, in the pages; nobody writes it so.
INTERNAL = '<span class="n">jaxlib</span><span class="o">.</span><span class="n">_jax</span>'
INTERNAL += '<span class="o">.</span>'


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
    """Write the pages. What pdoc complains of is an error, so that it does not go unseen."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        # optax's type of its states names one that only optax knows.
        warnings.filterwarnings("ignore", "Error parsing type annotation .*ArrayTree", UserWarning)
        write(folder, names)
    print(f"the reference is {folder / 'index.html'}", file=sys.stderr)


def write(folder: Path, names: Sequence[str]) -> None:
    """Write the pages of some modules, or of all."""
    names = list(names) or module_names()
    for name in jaxpend.__all__:
        setattr(jaxpend, name, getattr(jaxpend, name))  # pdoc looks for what is there already
    modules = {name: doc.Module(importlib.import_module(name)) for name in names}
    for name, module in modules.items():
        inside = [n for n in names if n.startswith(f"{name}.") and "." not in n[len(name) + 1 :]]
        module.submodules = [modules[n] for n in inside]
        for known in module.classes:
            describe(known)
    render.configure(docformat="google", footer_text=f"jaxpend {jaxpend.__version__}")
    for name, module in modules.items():
        page = render.html_module(module, modules).replace(INTERNAL, "").replace("jaxlib._jax.", "")
        write_atomically(folder / f"{name.replace('.', '/')}.html", page)
    write_atomically(folder / "index.html", render.html_index(modules))
    write_atomically(folder / "search.js", render.search_index(modules))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]), names=sys.argv[2:])

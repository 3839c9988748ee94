"""The reference: every public name has words, and its pages can be made without a warning."""

import importlib
import importlib.util
import inspect
import re
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent / "experiments" / "reference.py"


@pytest.fixture(scope="module")
def reference():
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("reference", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def silent(name):
    """Public functions and classes of a module that say nothing about themselves."""
    module = importlib.import_module(name)
    said = {name: module.__doc__}
    for public in getattr(module, "__all__", ()):
        thing = getattr(module, public)
        if inspect.isclass(thing) or inspect.isfunction(thing):
            words = thing.__doc__ or ""
            # What dataclass writes for a class without words is no description.
            said[f"{name}.{public}"] = words and not words.startswith(f"{thing.__name__}(")
    return [what for what, words in said.items() if not words]


def test_every_public_name_has_words(reference):
    names = reference.module_names()
    assert {"jaxpend", "jaxpend.plant", "jaxpend.report.page", "jaxpend.sac"} <= set(names)
    assert [what for name in names for what in silent(name)] == []


def test_pages_have_every_public_name_and_the_units_of_its_fields(reference, tmp_path):
    names = ["jaxpend", "jaxpend.plant", "jaxpend.controllers", "jaxpend.controllers.lqr"]
    reference.main(tmp_path, names)
    for name in names:
        page = (tmp_path / f"{name.replace('.', '/')}.html").read_text()
        module = importlib.import_module(name)
        for public in module.__all__:
            inside = inspect.ismodule(getattr(module, public))
            assert (f'id="{public}"' in page) or inside, (name, public)
    page = (tmp_path / "jaxpend" / "plant.html").read_text()
    assert re.search(r'id="Plant.mass".*?<p>\(2,\) kg</p>', page, re.DOTALL)
    assert 'href="jaxpend/controllers.html"' in (tmp_path / "jaxpend.html").read_text()
    assert "jaxpend.plant" in (tmp_path / "search.js").read_text()

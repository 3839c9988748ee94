"""What is said of errors in a user's own code."""

import importlib

import pytest

from jaxpend.errors import blame


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\nraise RuntimeError('my\\nbad')", "RuntimeError: my at {}/their_module.py:2"),
        ("def f(:", "SyntaxError: invalid syntax at {}/their_module.py:1"),
        ("\nimport none_such", "No module named 'none_such' at {}/their_module.py:2"),
        ("import json\njson.loads('{')", "line 1 column 2 (char 1) at {}/their_module.py:2"),
        ("import jax\njax.jit(lambda x: x.none)(1.0)", "at {}/their_module.py:2"),
        ("raise ValueError", "ValueError: no message at {}/their_module.py:1"),
    ],
)  # fmt: skip
def test_the_file_and_line_are_theirs(tmp_path, monkeypatch, text, words):
    (tmp_path / "their_module.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(importlib.sys.modules, "their_module", raising=False)
    with pytest.raises(Exception) as error:  # noqa: PT011
        importlib.import_module("their_module")
    said = blame(error.value)
    # The test that imported it is not theirs either, but outside the package all the same.
    assert said.endswith(words.format(tmp_path))
    assert "\n" not in said


def test_without_a_line_of_theirs_there_is_none():
    with pytest.raises(ModuleNotFoundError) as error:
        importlib.import_module("none_such")
    error.value.__traceback__ = error.value.__traceback__.tb_next
    assert blame(error.value) == "ModuleNotFoundError: No module named 'none_such'"
    assert blame(TypeError("x")) == "TypeError: x"

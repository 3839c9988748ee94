"""Options made of the parameters of a function, or of the fields of its configuration.

``--sac.env.dt 0.02``, or ``--sac.env.dt=0.02``, is the field ``dt`` of the section ``env`` of the
section ``sac``; a flag is ``--flag``, ``--no-flag``, or ``--flag`` with yes, no, on or off. Parsers
of libraries refuse in texts of their own, which no public interface lets one replace, so these few
rules are read here.
"""

import dataclasses
import difflib
import functools
import inspect
import re
import shlex
import shutil
import textwrap
import typing
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

from ..config_files import from_mapping, load_config, recipes
from ..errors import JaxpendError
from ..fields import OFF, ON, checked, described, hints_of, split

__all__ = ["parse", "similar"]

HELP, FULL_HELP = ("-h", "--help"), ("-H", "--help-verbose")
# One file serves several commands: sections that a command has no field for are passed over.
SECTIONS = ("policy", "sac", "gradient", "guard", "snes")
REQUIRED = inspect.Parameter.empty


@dataclasses.dataclass(frozen=True)
class Option:
    """What a command line can say of one parameter or field."""

    path: tuple[str, ...]  # of names: sections, then the field
    hint: Any
    default: Any
    owner: Any  # the function or configuration class that it belongs to
    positional: bool = False

    @property
    def name(self) -> str:
        """As it is typed; of a positional parameter what stands for it."""
        name = ".".join(self.path).replace("_", "-")
        return name.upper() if self.positional else f"--{name}"

    @property
    def negated(self) -> str:
        """How a flag is typed that is not meant."""
        return "--" + ".".join((*self.path[:-1], f"no-{self.path[-1]}")).replace("_", "-")

    @property
    def kind(self) -> Any:
        """The type, without bounds and None."""
        return split(self.hint)[0]

    def count(self) -> tuple[int, int | None]:
        """How many values it takes, at least and at most."""
        if self.kind is bool:
            return 0, 1
        if typing.get_origin(self.kind) is not tuple:
            return 1, 1
        inner = typing.get_args(self.kind)
        return 1, None if inner[-1] is ... else len(inner)


def parse(
    function: Callable[..., None], prog: str, args: Sequence[str], *, example: str = ""
) -> functools.partial[None]:
    """The call of ``function`` that a command line asks for; of help, one that prints it.

    Options are the function's parameters. A parameter ``config`` is a configuration, whose fields
    are options instead, after ``--config FILE``; ``command`` is given the whole command line.

    Raises:
        JaxpendError: an unknown option, a value of the wrong type, a file that cannot be used.
    """
    hints = hints_of(function)
    config = hints["config"]() if "config" in hints else None
    options = _options(function) if config is None else _fields(config, ())
    if asked := set(args) & {*HELP, *FULL_HELP}:
        full = config is None or bool(asked & set(FULL_HELP))
        return functools.partial(print, _help(function, prog, options, example, full))
    fixed = {"command": shlex.join([*prog.split(), *args])} if "command" in hints else {}
    if config is not None:
        rest, files = _files(args)
        for file in files:
            config = load_config(config, file, also=SECTIONS)
        values = _scan(rest, options, prog, ["--config"])
        return functools.partial(function, from_mapping(config, values, "", "--"), **fixed)
    values = _scan(args, options, prog, [])
    positional, named = [], {}
    for name, parameter in inspect.signature(function).parameters.items():
        if name in fixed:
            continue
        value = _value(name, hints[name], parameter, values)
        if parameter.kind is inspect.Parameter.POSITIONAL_ONLY:
            positional.append(value)
        elif name in values:
            named[name] = value
    return functools.partial(function, *positional, **named, **fixed)


def _value(name: str, hint: Any, parameter: inspect.Parameter, values: Mapping) -> Any:
    """The value of a parameter; its default where the command line says nothing."""
    if name not in values:
        return parameter.default
    if dataclasses.is_dataclass(hint):
        return from_mapping(parameter.default, values[name], "", f"--{name}.")
    positional = parameter.kind is inspect.Parameter.POSITIONAL_ONLY
    shown = Option((name,), hint, None, None, positional).name
    return checked(hint, values[name], shown, text=True)


def _options(function: Callable[..., None]) -> list[Option]:
    """The options of a function."""
    found, hints = [], hints_of(function)
    for name, parameter in inspect.signature(function).parameters.items():
        if dataclasses.is_dataclass(hints[name]):
            found += _fields(parameter.default, (name,))
        elif name != "command":
            positional = parameter.kind is inspect.Parameter.POSITIONAL_ONLY
            found.append(Option((name,), hints[name], parameter.default, function, positional))
    return found


def _fields(config: Any, path: tuple[str, ...]) -> list[Option]:
    """The options of a configuration, those of its sections last."""
    own, sections = [], []
    for name, hint in hints_of(type(config)).items():
        value = getattr(config, name)
        if dataclasses.is_dataclass(value):
            sections += _fields(value, (*path, name))
        else:
            own.append(Option((*path, name), hint, value, type(config)))
    return own + sections


# --- reading -------------------------------------------------------------------------------


def _is_option(token: str) -> bool:
    """Whether a token is an option and not a value: a negative number is a value, and so is "-"."""
    try:
        float(token)
    except ValueError:
        return token.startswith("-") and token != "-"
    return False


def _files(args: Sequence[str]) -> tuple[list[str], list[str]]:
    """A command line without ``--config FILE``, and the files."""
    rest, files, tokens = [], [], deque(args)
    while tokens:
        token = tokens.popleft()
        name, equals, path = token.partition("=")
        if name != "--config":
            rest.append(token)
            continue
        if not equals:
            path = tokens.popleft() if tokens and not _is_option(tokens[0]) else ""
        if not path:
            known = ", ".join(recipes())
            raise JaxpendError(f"--config needs a YAML file, or a recipe: {known}")
        files.append(path)
    return rest, files


def _scan(
    args: Sequence[str], options: Sequence[Option], prog: str, others: Sequence[str]
) -> dict[str, Any]:
    """What a command line says, as nested mappings of text; lists of text for several values."""
    named = {option.name: option for option in options if not option.positional}
    negated = {o.negated: o for o in named.values() if o.kind is bool}
    waiting = deque(option for option in options if option.positional)
    found: dict[tuple[str, ...], Any] = {}
    tokens, flag = deque(args), None
    while tokens:
        token = tokens.popleft()
        name, equals, value = token.partition("=")
        name = name.replace("_", "-")
        if not _is_option(token):
            if not waiting:
                if flag is not None:
                    raise JaxpendError(f"{flag.name} is {token!r}; it must be yes or no")
                raise JaxpendError(f"unexpected argument {token!r}; see {prog} --help")
            found[waiting.popleft().path] = token
        elif name in negated:
            if equals:
                raise JaxpendError(f"{name} takes no value; {negated[name].name} does")
            found[negated[name].path] = "no"
        elif name not in named:
            known = [*named, *negated, *others, "--help"]
            raise JaxpendError(f"unknown option {name}; {similar(name, known, prog)}")
        else:
            found[named[name].path] = _taken(named[name], [value] if equals else [], tokens)
        flag = named.get(name) if name in named and named[name].kind is bool else None
    missing = [o for o in options if o.default is REQUIRED and o.path not in found]
    if missing:
        raise JaxpendError(f"{missing[0].name} is missing; see {prog} --help")
    nested: dict[str, Any] = {}
    for (*sections, last), value in found.items():
        inner = nested
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[last] = value
    return nested


def _taken(option: Option, values: list[str], tokens: deque[str]) -> str | list[str]:
    """The values of an option: those after "=" and those that follow, which are taken away."""
    least, most = option.count()
    if option.kind is bool:
        if not values and tokens and tokens[0].lower() in ON + OFF:
            values.append(tokens.popleft())
        return values[0] if values else "yes"
    while tokens and len(values) != most and not _is_option(tokens[0]):
        values.append(tokens.popleft())
    if len(values) < least:
        raise JaxpendError(f"{option.name} needs a value: {described(option.hint)}")
    return values if most != 1 else values[0]


def similar(name: str, known: Sequence[str], prog: str) -> str:
    """What may have been meant, or where to look."""
    found = difflib.get_close_matches(name.replace("_", "-"), known, n=1)
    return f"did you mean {found[0]}?" if found else f"see {prog} --help"


# --- help ----------------------------------------------------------------------------------


def _help(
    function: Callable[..., None], prog: str, options: list[Option], example: str, full: bool
) -> str:
    """The help of a command; without ``full`` a line an option, which has the choices too."""
    width = min(max(shutil.get_terminal_size().columns, 40), 100)
    places = "".join(f" {o.name}" if o.default is REQUIRED else f" [{o.name}]"
                     for o in options if o.positional)  # fmt: skip
    lines = [f"usage: {prog}{places} [OPTIONS]", ""]
    summary = [_docstring(function).partition("\n\n")[0]]
    if "config" in hints_of(function):
        summary.append(
            f"--config FILE reads a YAML file first, or a recipe that ships with the package "
            f"({', '.join(recipes())}); the options override it."
        )
        summary.append("-H shows what every option means." if not full else "")
    for paragraph in filter(None, summary):
        lines += textwrap.wrap(" ".join(paragraph.split()), width)
    lines += ["", f"example: {prog} {example}"] if example else []
    section: tuple[str, ...] | None = None
    for option in options:
        if option.path[:-1] != section:
            section = option.path[:-1]
            title = f"{'.'.join(section)}: {_first_sentence(option.owner)}" if section else ""
            lines += ["", *textwrap.wrap(title or "options:", width)]
        lines += _entry(option, width, full)
    return "\n".join(lines)


def _entry(option: Option, width: int, full: bool) -> list[str]:
    names = option.name
    if option.kind is bool:
        names += f", {option.negated}"
    elif not option.positional:
        names += f" {_metavar(option.kind)}"
    shown = option.default
    if isinstance(shown, bool):
        shown = "yes" if shown else "no"
    if isinstance(shown, tuple):
        shown = " ".join(map(str, shown))
    default = "" if shown in (None, "", REQUIRED) else f" (default: {shown})"
    if option.default is REQUIRED and not option.positional:
        default = " (required)"
    lines = [f"  {names}{default}"]
    if full and (about := _about(option.owner).get(option.path[-1])):
        lines += textwrap.wrap(about, width, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return lines


def _metavar(kind: Any) -> str:
    inner = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return "|".join(inner)
    if typing.get_origin(kind) is tuple:
        each = _metavar(split(inner[0])[0])
        return f"{each} ..." if inner[-1] is ... else " ".join([each] * len(inner))
    return {int: "INTEGER", float: "NUMBER", str: "TEXT"}.get(kind, "PATH")


def _docstring(owner: Any) -> str:
    return inspect.getdoc(owner) or ""


def _first_sentence(owner: Any) -> str:
    text = " ".join(_docstring(owner).partition("\n\n")[0].split())
    return text.partition("; see")[0].rstrip(".") + "."


@functools.cache
def _about(owner: Any) -> dict[str, str]:
    """Name -> what it means: ``Args`` of a docstring, or the comment behind or above a field."""
    if not isinstance(owner, type):
        args = _docstring(owner).partition("Args:\n")[2].partition("\n\n")[0]
        parts = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", args, re.MULTILINE)
        return {name: " ".join(text.split()) for name, text in parts}
    found: dict[str, str] = {}
    for kind in reversed(owner.__mro__[:-1]):
        above = ""
        for line in inspect.getsource(kind).splitlines():
            field = re.match(r"    (\w+): .*?(?:  # (.*))?$", line)
            if field and (said := field[2] or above):
                found[field[1]] = said
            above = line.removeprefix("    # ") if line.startswith("    # ") else ""
    return found

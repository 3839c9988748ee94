"""Options made of the parameters of a function, or of the fields of its configuration.

``--sac.env.dt 0.02``, or ``--sac.env.dt=0.02``, is the field ``dt`` of the section ``env`` of the
section ``sac``; a flag is ``--flag``, ``--no-flag``, or ``--flag`` with yes, no, on or off.
"""

import argparse
import dataclasses
import difflib
import functools
import inspect
import re
import shlex
import shutil
import typing
from collections.abc import Callable, Sequence
from typing import Any, Literal, NoReturn

from ..config import GradientRun, SNESRun, TrainRun
from ..config_files import from_mapping, load_config, recipes
from ..errors import JaxpendError
from ..fields import OFF, ON, checked, described, hints_of, split

__all__ = ["parse", "similar"]

HELP, FULL_HELP = {"-h", "--help"}, {"-H", "--help-verbose"}
REQUIRED = inspect.Parameter.empty
# Before a word: it is a value, whatever it looks like. A shell cannot pass this character.
VALUE = "\0"


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
    full = "config" not in hints or not FULL_HELP.isdisjoint(args)
    asked = not (HELP | FULL_HELP).isdisjoint(args)
    parser = _Parser(function, prog, example, ("full" if full else "short") if asked else "")
    if asked:
        return functools.partial(print, parser.format_help().rstrip())
    values, positional, named = parser.values(args), [], {}
    for name, parameter in inspect.signature(function).parameters.items():
        if name == "command":
            named[name] = shlex.join([*prog.split(), *args])
        elif name == "config":
            config, files = hints[name](), [f.removeprefix(VALUE) for f in values.pop(name, [])]
            if "" in files:
                known = ", ".join(recipes())
                raise JaxpendError(f"--config needs a YAML file, or a recipe: {known}")
            for file in files:
                # One file serves several commands: what only others have is passed over.
                kinds = (GradientRun, SNESRun, TrainRun)
                others = [name for kind in kinds for name in hints_of(kind)]
                config = load_config(config, file, also=others)
            positional.append(from_mapping(config, values, "", "--"))
        elif dataclasses.is_dataclass(hints[name]):
            named[name] = from_mapping(parameter.default, values.get(name, {}), "", f"--{name}.")
        else:
            option, value = parser.options[name], values.get(name, parameter.default)
            named[name] = checked(hints[name], value, option.shown, text=True)
    positional += [named.pop(place.dest) for place in parser.places]
    return functools.partial(function, *positional, **named)


def similar(name: str, known: Sequence[str], prog: str) -> str:
    """What may have been meant, or where to look."""
    found = difflib.get_close_matches(name.replace("_", "-"), known, n=1)
    return f"did you mean {found[0]}?" if found else f"see {prog} --help"


class _Option(argparse.Action):
    """Keeps the text that is given for a parameter or a field."""

    def __init__(self, option_strings: Sequence[str], dest: str, hint: Any, default: Any,
                 **others: Any) -> None:  # fmt: skip
        super().__init__(option_strings, dest, default=argparse.SUPPRESS, **others)
        self.hint, self.needed = hint, default is REQUIRED
        self.shown = option_strings[0] if option_strings else dest.upper()

    def __call__(self, parser: Any, namespace: Any, values: Any, name: str | None = None) -> None:
        if values is None or values == []:
            raise JaxpendError(f"{self.shown} needs a value: {described(self.hint)}")
        if name is None and self.dest in namespace:
            parser.error(f"unexpected argument {values!r}")
        many = isinstance(values, list)
        text = [v.removeprefix(VALUE) for v in values] if many else values.removeprefix(VALUE)
        setattr(namespace, self.dest, text)


class _Flag(_Option):
    """Keeps yes or no: the word that follows, or what the name of the option means."""

    def __call__(self, parser: Any, namespace: Any, values: Any, name: str | None = None) -> None:
        negated, places = name != self.shown, [p for p in parser.places if p.dest not in namespace]
        word = "" if values is None else values.lower()
        if word and places and word[0] != VALUE and (negated or word not in ON + OFF):
            places[0](parser, namespace, values)  # as in "--no-robustness runs/mine"
            values = None
        if values is None:
            values = "no" if negated else "yes"
        elif negated:
            raise JaxpendError(f"{name} takes no value; {self.shown} does")
        super().__call__(parser, namespace, values, name)
        checked(self.hint, getattr(namespace, self.dest), self.shown, text=True)


class _Parser(argparse.ArgumentParser):
    """Reads the options of a function; or shows them, where ``shows`` is "short" or "full"."""

    def __init__(self, function: Callable[..., None], prog: str, example: str, shows: str) -> None:
        width = min(max(shutil.get_terminal_size().columns, 40), 100)
        look = functools.partial(argparse.HelpFormatter, width=width, max_help_position=6)
        super().__init__(prog, formatter_class=look, add_help=False, allow_abbrev=False)
        self.shows, self.known, self.options = shows, ["--help"], dict[str, _Option]()
        self.description = f"{_summary(function)}."
        if "config" in hints_of(function):
            file = "a YAML file, or a recipe that ships with the package"
            self.known.append("--config")
            self.add_argument(
                "--config", metavar="FILE", action="append", default=argparse.SUPPRESS,
                nargs=None if shows else "?", const=None if shows else "",
                help=f"{file} ({', '.join(recipes())}); the other options override it; without "
                "one, the defaults, which are none of the recipes",
            )  # fmt: skip
            self.description += " -H shows what every option means." if shows == "short" else ""
        self.add_options(function, ())
        self.places = [option for option in self.options.values() if not option.option_strings]
        words = [p.shown if p.needed else f"[{p.shown}]" for p in self.places]
        self.usage = " ".join(["%(prog)s", *words, "[OPTIONS]"])
        self.usage += f"\n\nexample: %(prog)s {example}" if example else ""

    def error(self, message: str) -> NoReturn:
        """Refuse in a sentence."""
        raise JaxpendError(f"{message}; see {self.prog} --help")

    def add_options(self, owner: Any, path: tuple[str, ...]) -> None:
        """Add those of a function or a configuration, the ones of its sections last."""
        is_function, sections = inspect.isfunction(owner), dict[tuple[str, ...], Any]()
        kind: Any = owner if is_function else type(owner)
        parameters = inspect.signature(owner).parameters if is_function else {}
        values = {n: p.default for n, p in parameters.items()} if is_function else vars(owner)
        group = self.add_argument_group(f"{'.'.join(path)}: {_summary(kind)}") if path else self
        for name, hint in hints_of(kind).items():
            if name == "config":
                sections[()] = hint()
            elif dataclasses.is_dataclass(hint):
                sections[*path, name] = values[name]
            elif name != "command":
                place = is_function and parameters[name].kind is inspect.Parameter.POSITIONAL_ONLY
                about = _about(kind).get(name) if self.shows == "full" else None
                self.add_option(group, (*path, name), hint, values[name], place, about)
        for inner, section in sections.items():
            self.add_options(section, inner)

    def add_option(self, group: Any, path: tuple[str, ...], hint: Any, default: Any, place: bool,
                   about: str | None) -> None:  # fmt: skip
        """Add one to a group; ``place`` says that it is positional."""
        kind, dest = split(hint)[0], ".".join(path)
        names = [] if place else [f"--{dest}".replace("_", "-")]
        if kind is bool:
            names.append("--" + ".".join((*path[:-1], f"no-{path[-1]}")).replace("_", "-"))
        self.known += names
        nargs: str | None = "*" if typing.get_origin(kind) is tuple else "?"
        metavar = None
        if self.shows:  # without the brackets around what argparse would let one leave out
            nargs, names = None, [", ".join(names)] if names else []
            metavar = f"{dest.upper() if place else _metavar(kind)}{_default(default)}".strip()
        self.options[dest] = group.add_argument(
            *names, action=_Flag if kind is bool else _Option, dest=dest, hint=hint,
            default=default, nargs=nargs, metavar=metavar, help=about and about.replace("%", "%%"),
        )  # fmt: skip

    def values(self, args: Sequence[str]) -> dict[str, Any]:
        """What a command line says, as nested mappings of text; lists for several values."""
        end = [*args, "--"].index("--")  # behind it are no options
        given, rest = self.parse_known_args([*map(_spelled, args[:end]), *args[end:]])
        for word in rest:
            if word == "--":
                continue
            name = word.partition("=")[0]
            if name.startswith("-") and name != "-":
                raise JaxpendError(f"unknown option {name}; {similar(name, self.known, self.prog)}")
            self.error(f"unexpected argument {word.removeprefix(VALUE)!r}")
        for option in self.options.values():
            if option.needed and option.dest not in given:
                self.error(f"{option.shown} is missing")
        nested: dict[str, Any] = {}
        for dest, value in vars(given).items():
            *sections, last = dest.split(".")
            inner = functools.reduce(lambda d, name: d.setdefault(name, {}), sections, nested)
            inner[last] = value
        return nested


def _spelled(word: str) -> str:
    """A word as ``argparse`` reads it: hyphens in names, and ``VALUE`` before what is a value."""
    name, equals, value = word.partition("=")
    if name.startswith("--"):
        return name.replace("_", "-") + (f"={VALUE}{value}" if equals else "")
    try:
        float(word)
    except ValueError:
        return word
    return VALUE + word if name.startswith("-") else word  # "-2e1" would be taken for an option


def _default(value: Any) -> str:
    if value is REQUIRED:
        return " (required)"
    if isinstance(value, bool):
        value = "yes" if value else "no"
    if isinstance(value, tuple):
        value = " ".join(map(str, value))
    return "" if value in (None, "") else f" (default: {value})"


def _metavar(kind: Any) -> str:
    inner = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return "|".join(inner)
    if typing.get_origin(kind) is tuple:
        each = _metavar(split(inner[0])[0])
        return f"{each} ..." if inner[-1] is ... else " ".join([each] * len(inner))
    return {int: "INTEGER", float: "NUMBER", str: "TEXT", bool: ""}.get(kind, "PATH")


def _summary(owner: Any) -> str:
    text = " ".join((inspect.getdoc(owner) or "").partition("\n\n")[0].split())
    return text.partition("; see")[0].rstrip(".")


@functools.cache
def _about(owner: Any) -> dict[str, str]:
    """Name -> what it means: ``Args`` of a docstring, or the comment behind or above a field."""
    if not isinstance(owner, type):
        args = (inspect.getdoc(owner) or "").partition("Args:\n")[2].partition("\n\n")[0]
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

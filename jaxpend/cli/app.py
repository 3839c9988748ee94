"""The command line: which commands there are, their options, one-sentence errors, exit codes."""

import contextlib
import dataclasses
import difflib
import functools
import importlib
import inspect
import os
import re
import shlex
import signal
import sys
import types
import typing
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from .. import __version__
from ..errors import JaxpendError
from ..files import to_json, write_atomically

__all__ = ["COMMANDS", "Command", "compile_cache", "emit_json", "guard", "main", "parse", "run"]


@dataclasses.dataclass(frozen=True)
class Command:
    """A subcommand. Its function is imported when it is called for."""

    group: str
    summary: str
    example: str  # its arguments
    function: str = ""  # module:name; by default the function of its name in ``commands``


COMMANDS = {
    "train": Command(
        "train a policy",
        "SAC, then SNES, then the official score",
        "--config pendubot --seed 1",
    ),
    "sac": Command(
        "train a policy",
        "SAC on the surrogate reward",
        "--config pendubot --seed 1",
    ),
    "gradient": Command(
        "train a policy",
        "the gradient of the smooth score, from a policy or any other controller",
        "--robot acrobot --policy runs/mine/sac_best.npz --gradient.steps 1000",
    ),
    "snes": Command(
        "train a policy",
        "SNES on the official score, from a policy or any other controller",
        "--robot acrobot --policy runs/mine/sac_best.npz --snes.generations 400",
    ),
    "score": Command(
        "judge a controller",
        "official v2 score of a policy, in float64",
        "--robot acrobot --policy runs/mine/policy.npz --json -",
    ),
    "robustness": Command(
        "judge a controller",
        "six-criterion robustness benchmark of a controller",
        "--robot pendubot --policy runs/mine/policy.npz",
    ),
    "leaderboard": Command(
        "judge a controller",
        "every known controller on both boards, next to the published rows",
        "--robot acrobot --no-robustness",
    ),
    "runs": Command(
        "look at runs",
        "list runs with their state and scores",
        "runs --json -",
    ),
    "report": Command(
        "look at runs",
        "one page about a run, with pictures",
        "runs/mine",
    ),
    "optimise": Command(
        "optimise a trajectory",
        "find the best swing-up",
        "--robot acrobot --out swingup.npz",
    ),
}
CACHE_VARIABLE = "JAXPEND_CACHE"
OFF = ("off", "no", "false", "0")
ON = ("on", "yes", "true", "1")


@contextlib.contextmanager
def guard(prog: str) -> Iterator[None]:
    """Turn what goes wrong in a command into one sentence on standard error and an exit code.

    2 for a ``JaxpendError`` or an unusable file system, 130 after Ctrl-C, 143 after SIGTERM where
    a loop waits for a good moment to stop (``interrupt``).
    """
    try:
        yield
    except JaxpendError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        where = f" {error.filename}" if error.filename else ""
        print(f"{prog}: cannot use{where}: {error.strerror or error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        text = str(stop) or "interrupted"
        print(f"{prog}: {text}", file=sys.stderr)
        sys.exit(128 + getattr(stop, "signum", signal.SIGINT))


def main(*prefix: str) -> NoReturn:
    """``jaxpend``: help, version, or a subcommand, by ``prefix`` and the command line; exits."""
    name, *rest = [*prefix, *sys.argv[1:]] or ["--help"]
    with guard("jaxpend"):
        if name in ("-h", "--help"):
            print(overview())
        elif name == "--version":
            print(versions())
        elif name not in COMMANDS:
            what = "option" if name.startswith("-") else "command"
            hint = _similar(name, [*COMMANDS, "--help", "--version"]) or "see jaxpend --help"
            raise JaxpendError(f"unknown {what} {name!r}; {hint}")
        else:
            command = COMMANDS[name]
            module, _, function = (command.function or f"commands:{name}").partition(":")
            found = getattr(importlib.import_module(f".{module}", __package__), function)
            run(found, f"jaxpend {name}", rest, example=command.example)
    sys.exit(0)


def run(
    function: Callable[..., None],
    prog: str,
    args: Sequence[str] | None = None,
    *,
    example: str = "",
) -> NoReturn:
    """Call a function with the parameters that the command line gives, under ``guard``; exit."""
    with guard(prog):
        call = parse(function, prog, sys.argv[1:] if args is None else args, example=example)
        compile_cache()
        call()
    sys.exit(0)


def overview() -> str:
    """The help of ``jaxpend`` itself."""
    lines = ["usage: jaxpend COMMAND [OPTIONS]", "", "Train and judge controllers for the acrobot"]
    lines[-1] += " and the pendubot, end to end in JAX."
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        lines += ["", f"{group}:"]
        lines += [f"  {n:<12} {c.summary}" for n, c in COMMANDS.items() if c.group == group]
    lines += ["", "example:", f"  jaxpend train {COMMANDS['train'].example}", ""]
    lines += ["jaxpend COMMAND --help lists a command's options, jaxpend --version the versions."]
    lines += [
        f"Compiled programs are kept in the user's cache folder: {CACHE_VARIABLE}=FOLDER moves"
    ]
    lines += [f"them, {CACHE_VARIABLE}=off keeps none."]
    return "\n".join(lines)


def versions() -> str:
    """Versions of what decides about results; loads no backend."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"jaxpend": __version__}
    for name in ("jax", "jaxlib"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    found["python"] = ".".join(map(str, sys.version_info[:3]))
    return "\n".join(f"{name} {number}" for name, number in found.items())


# --- options -------------------------------------------------------------------------------


def parse(
    function: Callable[..., None], prog: str, args: Sequence[str], *, example: str = ""
) -> Callable[[], None]:
    """The call of ``function`` that a command line asks for.

    Options are the function's parameters. A function with the parameters ``config``, a
    configuration dataclass, and ``command`` has the configuration's fields as options, and
    ``--config FILE`` for a YAML file under them; ``command`` is the command line.

    Raises:
        JaxpendError: an unknown option, a value of the wrong type, a file that cannot be used.
    """
    import tyro

    hints = typing.get_type_hints(function)
    summary = inspect.getdoc(function).partition("\n\n")[0]
    given, target, default = [*args], _deferred(function), tyro.MISSING_NONPROP
    if "config" in hints:
        target, default, args = _configured(hints["config"], args)
        summary += "\n--config FILE reads a YAML file first; the options override it."
    options = _options(target)
    if example:
        summary += f"\n\nexample: {prog} {example}"

    def refuse(event) -> None:
        complaint = _complaint(event, options, given, prog)
        if complaint is not None:
            raise JaxpendError(complaint)

    # The hook is not public yet: without it, tyro says in a box of its own what is wrong.
    hook = getattr(getattr(tyro, "_errors", None), "on_parse_error", contextlib.nullcontext)
    with hook(refuse):
        parsed = tyro.cli(
            target, default=default, args=_spelled_out(args, options), prog=prog,
            description=summary, compact_help="config" in hints,
        )  # fmt: skip
    if "config" in hints:
        return functools.partial(function, parsed, command=shlex.join([*prog.split(), *given]))
    return parsed


def _configured(kind: type, args: Sequence[str]) -> tuple[type, Any, list[str]]:
    """A configuration class, its defaults with ``--config FILE`` over them, the other arguments."""
    rest, default = [], kind()
    tokens = iter(args)
    for token in tokens:
        name, equals, path = token.partition("=")
        if name != "--config":
            rest.append(token)
            continue
        path = path if equals else next(tokens, "--")
        if path.startswith("--") or not path:
            raise JaxpendError("--config needs a YAML file")
        from ..runs.folder import load_config

        # One file serves several commands: sections that this one has no field for are passed over.
        default = load_config(default, path, also=("policy", "sac", "gradient", "guard", "snes"))
    return kind, default, rest


def _deferred(function: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """A function with the same parameters whose result is the call that is to be made."""

    @functools.wraps(function)
    def deferred(*args, **kwargs):
        return functools.partial(function, *args, **kwargs)

    # A description that goes on in another line is one paragraph, which tyro breaks anew. It would
    # read the docstring of what is wrapped.
    deferred.__signature__ = inspect.signature(function)
    del deferred.__wrapped__
    deferred.__doc__ = re.sub(r"\n {8,}", " ", inspect.getdoc(function))
    return deferred


def _options(kind: Any, prefix: str = "--") -> dict[str, Any]:
    """Name -> type of the options that a function or a configuration has."""
    found, parameters = {}, inspect.signature(kind).parameters
    for name, hint in typing.get_type_hints(kind).items():
        if name not in parameters or parameters[name].kind is inspect.Parameter.POSITIONAL_ONLY:
            continue
        option = prefix + name.replace("_", "-")
        found |= _options(hint, option + ".") if dataclasses.is_dataclass(hint) else {option: hint}
    return found


def _spelled_out(args: Sequence[str], options: Mapping[str, Any]) -> list[str]:
    """``--flag yes`` and ``--flag=off`` as ``--flag`` and ``--no-flag``, which tyro reads."""
    spelled: list[str] = []
    for token in args:
        name, equals, value = token.partition("=")
        flag = spelled[-1] if spelled and not equals else name
        value = (value if equals else token).lower()
        if options.get(flag.replace("_", "-")) is not bool or value not in ON + OFF:
            spelled.append(token)
            continue
        if not equals:
            spelled.pop()
        section, dot, last = flag.removeprefix("--").rpartition(".")
        spelled.append(f"--{section}{dot}{'no-' if value in OFF else ''}{last}")
    return spelled


def _described(hint: Any) -> str:
    """What a value of a type is, in words."""
    inner = [part for part in typing.get_args(hint) if part is not type(None)]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return _described(inner[0])
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(inner)
    if typing.get_origin(hint) is tuple:
        many = "any number of" if inner[-1] is ... else str(len(inner))
        return f"{many} values, each {_described(inner[0])}"
    return {int: "an integer", float: "a number", Path: "a path", bool: "yes or no"}.get(
        hint, "a text"
    )


def _similar(name: str, known: Sequence[str]) -> str:
    found = difflib.get_close_matches(name.replace("_", "-"), known, n=1)
    return f"did you mean {found[0]}?" if found else ""


def _complaint(
    event: Any, options: Mapping[str, Any], args: Sequence[str], prog: str
) -> str | None:
    """What tyro found wrong, in one sentence; None where it has to say so itself."""
    kind, help_ = type(event).__name__, f"see {prog} --help"
    if kind == "UnrecognizedArgs":
        token = event.tokens[0].partition("=")[0]
        if token.startswith("-"):
            known = [*options, "--config", "--help"]
            return f"unknown option {token}; {_similar(token, known) or help_}"
        before = args[args.index(token) - 1] if token in args[1:] else ""
        if options.get(before) is bool:
            return f"{before} is {token!r}; it must be yes or no"
        return f"unexpected argument {token!r}; {help_}"
    if kind == "MissingArgs":
        argument = event.missing_arguments[0].arg
    elif kind in ("BadValue", "InvalidChoice", "InstantiationFailure") and event.argument:
        argument = event.argument
    else:
        return None
    name = argument.lowered.name_or_flags[-1]
    if argument.is_positional():
        name = argument.lowered.metavar.strip("[]")
    right = _described(options.get(name, str))
    if kind == "MissingArgs":
        return f"{name} is missing; {help_}"
    if kind == "BadValue":
        return f"{name} needs a value: {right}"
    given = [event.value] if kind == "InvalidChoice" else _given(name, args)
    return f"{name} is {' '.join(given)!r}; it must be {right}"


def _given(name: str, args: Sequence[str]) -> list[str]:
    """The values that an option has on the command line."""
    values: list[str] = []
    inside = False
    for token in args:
        flag, equals, value = token.partition("=")
        if token.startswith("--"):
            inside = flag.replace("_", "-") == name
            values = [value] if inside and equals else [] if inside else values
        elif inside:
            values.append(token)
    return values


# --- what commands write -------------------------------------------------------------------


def emit_json(value: Any, target: str | Path | None) -> None:
    """Write ``value`` as JSON to standard output ("-") or, atomically, to a file; None: nowhere."""
    if target is None:
        return
    text = to_json(value, indent=2) + "\n"
    if str(target) == "-":
        sys.stdout.write(text)
    else:
        write_atomically(target, text)


# --- compiled programs ---------------------------------------------------------------------


def _cache_folder() -> Path | None:
    """Where to keep compiled programs; None: nowhere, or the user has told jax already."""
    said = os.environ.get(CACHE_VARIABLE, "")
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or said.lower() in OFF:
        return None
    if said and said.lower() not in ON:
        return Path(said).expanduser()
    # The XDG specification: a relative path is invalid and ignored.
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    base = base if base.is_absolute() else Path("~/.cache").expanduser()
    return base / "jaxpend" / "xla"


def compile_cache() -> None:
    """Keep compiled programs for the next start. The one place that configures jax and XLA.

    What the environment says already has the last word. A folder that cannot be written is passed
    over, since nothing depends on it.
    """
    folder = _cache_folder()
    try:
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            return
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return
    # XLA complains on every load on some CPUs, where it takes tuning hints for instructions.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    warnings.filterwarnings("ignore", message=".*persistent compilation cache")
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0.2,  # less is not worth a file
    }
    for name, value in settings.items():
        if name.upper() not in os.environ:
            os.environ[name.upper()] = str(value)
            if "jax" in sys.modules:  # python -m jaxpend.X: it has read its environment already
                sys.modules["jax"].config.update(name, value)

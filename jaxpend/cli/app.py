"""The command line: which commands there are, one-sentence errors, exit codes."""

import contextlib
import dataclasses
import importlib
import keyword
import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import NoReturn

from .. import __version__
from ..errors import JaxpendError
from .cache import VARIABLE, check_platform, compile_cache, share_processor
from .options import parse, similar
from .output import drop_unwritable

__all__ = ["COMMANDS", "Command", "function_of", "main", "one_sentence", "run"]


@dataclasses.dataclass(frozen=True)
class Command:
    """A subcommand; its function in ``commands`` has its name (see ``function_of``)."""

    group: str = ""
    summary: str = ""
    example: str = ""  # its arguments, for the help
    computes: bool = True  # with jax


COMMANDS = {
    "train": Command(
        "train a policy",
        "SAC, the gradient and SNES, as a recipe says; ends with the official score",
        "--config pendubot --seed 1",
    ),
    "sac": Command("train a policy", "SAC on the surrogate reward", "--config pendubot --seed 1"),
    "gradient": Command(
        "train a policy",
        "the gradient of the smooth score, from a policy or any other controller",
        "--robot acrobot --policy runs/mine/sac_best.npz --gradient.steps 1000",
    ),
    "shac": Command(
        "train a policy",
        "the gradient in short windows with a critic, from a policy of the v3 board",
        "--board v3 --robot pendubot --policy runs/mine/sac_best.npz",
    ),
    "snes": Command(
        "train a policy",
        "SNES on the official score, from a policy or any other controller",
        "--robot acrobot --policy runs/mine/sac_best.npz --snes.generations 400",
    ),
    "score": Command(
        "judge a controller",
        "official score of a policy or a recorded run",
        "--robot acrobot --policy runs/mine/policy.npz --json -",
    ),
    "robustness": Command(
        "judge a controller",
        "six-criterion robustness benchmark of a controller",
        "--robot pendubot --policy runs/mine/policy.npz",
    ),
    "hardware": Command(
        "judge a controller",
        "how often it stands on a fleet of real robots, without and with pushes",
        "--robot pendubot --policy runs/mine/policy.npz",
    ),
    "leaderboard": Command(
        "judge a controller",
        "every known controller on the board of a robot, next to the published rows",
        "--robot acrobot --no-robustness",
    ),
    "import": Command(
        "in and out",
        "a policy file of a Stable-Baselines3 model",
        "model.zip --robot pendubot --preset evolsac --out policy.npz",
    ),
    "export": Command(
        "in and out",
        "a controller for numpy, ONNX, C or RealAIGym",
        "runs/mine/policy.npz --to c --out policy.h",
    ),
    "runs": Command(
        "look at runs", "list runs with their state and scores", "runs --json -", computes=False
    ),
    "report": Command("look at runs", "one page about a run, with pictures", "runs/mine"),
    "identify": Command(
        "in and out",
        "a plant file of a robot, fitted to recorded runs of it",
        "run1.csv run2.csv --design C.1/1.0 --out robot.yaml",
    ),
    "optimise": Command(
        "optimise a trajectory", "find the best swing-up", "--robot acrobot --out swingup.npz"
    ),
}


# How jax tells that Ctrl-C came while a compiled loop was in a user's Python function.
INTERRUPTED = re.compile(r"^(?:\w+: )*KeyboardInterrupt\b", re.MULTILINE)


def _is_somewhere() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return False
    return True


@contextlib.contextmanager
def one_sentence(prog: str) -> Iterator[None]:
    """Turn what goes wrong in a command into one sentence on standard error and an exit code.

    2 for a ``JaxpendError``, an unusable file system or too little memory, 130 after Ctrl-C, 143
    after SIGTERM where a loop waits for a good moment to stop (``train.interrupt``); and, without
    a word, 141 where nobody reads the output any more, as of a program that SIGPIPE kills.
    """
    try:
        yield
        if sys.stdout is not None:
            sys.stdout.flush()
        return
    except JaxpendError as error:
        code, text = 2, str(error)
    except BrokenPipeError:
        code, text = 128 + signal.SIGPIPE, ""
    except OSError as error:
        where = f" {error.filename}" if error.filename else ""
        code, text = 2, f"cannot use{where}: {error.strerror or error}"
        if not where and not _is_somewhere():
            text = "the current folder is gone; change to one that is there"
    except (MemoryError, RuntimeError) as error:
        code, text = 2, in_words(error)
        if INTERRUPTED.search(str(error)):
            code, text = 128 + signal.SIGINT, "interrupted"
        if not text:
            raise
    except KeyboardInterrupt as stop:
        code, text = 128 + getattr(stop, "signum", signal.SIGINT), str(stop) or "interrupted"
    if text and sys.stderr is not None:
        # In one line, whatever a name in it holds.
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
        with contextlib.suppress(OSError):
            print(f"{prog}: {text}", file=sys.stderr)
    drop_unwritable()
    if (hosts := sys.modules.get("jaxpend.hosts")) is not None:
        hosts.leave(code)
    sys.exit(code)


def in_words(error: MemoryError | RuntimeError) -> str:
    """What numpy or jax say in an error that is no bug of this package; empty for one that is."""
    text = str(error)
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in text:
        return f"there is too little memory: {text.partition(chr(10))[0] or 'ask for less'}"
    # What a Python function has done in a compiled loop: jax gives its traceback as text.
    refused = re.findall(r"^(?:[\w.]+\.)?JaxpendError: (.+)$", text, re.MULTILINE)
    return refused[-1] if refused else ""


def main(*prefix: str) -> NoReturn:
    """``jaxpend``: help, version, or a subcommand, by ``prefix`` and the command line; exits."""
    name, *rest = [*prefix, *sys.argv[1:]] or ["--help"]
    with one_sentence("jaxpend"):
        if name in ("-h", "--help"):
            print(overview())
        elif name == "--version":
            print(versions())
        elif name not in COMMANDS:
            what = "option" if name.startswith("-") else "command"
            hint = similar(name, [*COMMANDS, "--help", "--version"], "jaxpend")
            raise JaxpendError(f"unknown {what} {name!r}; {hint}")
        else:
            run(function_of(name), f"jaxpend {name}", rest, COMMANDS[name])
    sys.exit(0)


def function_of(name: str) -> Callable[..., None]:
    """The function behind a command; that of ``import``, a keyword of Python, is ``import_``."""
    commands = importlib.import_module(".commands", __package__)
    return getattr(commands, f"{name}_" if keyword.iskeyword(name) else name)


def run(function: Callable[..., None], prog: str, args: Sequence[str] | None = None,
        about: Command = Command()) -> NoReturn:  # fmt: skip
    """Call a function with the parameters that the command line gives; exit."""
    with one_sentence(prog):
        args = sys.argv[1:] if args is None else args
        call = parse(function, prog, args, example=about.example)
        if call.func is not print:  # which prints the help
            compile_cache()
            if about.computes:
                share_processor()
                check_platform()
                # It prints the traceback of a user's function, which becomes a sentence here.
                logging.getLogger("jax._src.callback").setLevel(logging.CRITICAL)
        call()
    sys.exit(0)


def overview() -> str:
    """The help of ``jaxpend`` itself."""
    lines = ["usage: jaxpend COMMAND [OPTIONS]", ""]
    lines += ["Train and judge controllers for the acrobot and the pendubot, end to end in JAX."]
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        lines += ["", f"{group}:"]
        lines += [f"  {n:<12} {c.summary}" for n, c in COMMANDS.items() if c.group == group]
    lines += ["", "example:", f"  jaxpend train {COMMANDS['train'].example}", ""]
    lines += ["jaxpend COMMAND --help lists a command's options, jaxpend --version the versions."]
    lines += [f"{VARIABLE}=FOLDER: where compiled programs are kept; {VARIABLE}=off: none are."]
    return "\n".join(lines)


def versions() -> str:
    """Versions of what decides about results; loads no backend."""
    from importlib.metadata import version

    found = {"jaxpend": __version__, "jax": version("jax"), "jaxlib": version("jaxlib")}
    found["python"] = ".".join(map(str, sys.version_info[:3]))
    return "\n".join(f"{name} {number}" for name, number in found.items())

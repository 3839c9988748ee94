"""What every command shares: argument parsing, one-sentence errors, exit codes, JSON output."""

import argparse
import contextlib
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from .errors import JaxpendError
from .files import to_json, write_atomically

__all__ = ["configure", "emit_json", "guard", "run"]

T = TypeVar("T")


@contextlib.contextmanager
def guard(prog: str) -> Iterator[None]:
    """Turn what goes wrong in a command into one sentence on standard error and an exit code.

    2 for a ``JaxpendError`` or an unusable file system, 130 after Ctrl-C, 143 after SIGTERM where
    a command waits for a good moment to stop (``interrupt.Stopped``).
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
        print(f"{prog}: {str(stop) or 'interrupted'}", file=sys.stderr)
        sys.exit(128 + getattr(stop, "signum", signal.SIGINT))


def run(main: Callable[..., None], prog: str) -> NoReturn:
    """Parse the command line into ``main``'s parameters (tyro), call it under ``guard``, exit."""
    import tyro

    with guard(prog):
        tyro.cli(main, prog=prog, config=(tyro.conf.FlagConversionOff,))
    sys.exit(0)


def configure(default: T, prog: str, description: str, also: Sequence[str] = ()) -> T:
    """A configuration from the command line: ``--config FILE`` first, then any field over it.

    Sections of the file named in ``also`` that this command has no field for are passed over, so
    that one file serves several commands.

    Raises:
        JaxpendError: the file cannot be used, or it names an unknown field.
    """
    import tyro

    from .runs import load_config

    files = argparse.ArgumentParser(prog=prog, add_help=False, allow_abbrev=False)
    files.add_argument("--config")
    named, rest = files.parse_known_args()
    if named.config:
        default = load_config(default, named.config, also)
    description += "\n\n--config FILE reads a YAML file first; the options below override it."
    return tyro.cli(type(default), default=default, args=rest, prog=prog, description=description)


def emit_json(value: Any, target: str | Path | None) -> None:
    """Write ``value`` as JSON to standard output ("-") or, atomically, to a file; None: nowhere."""
    if target is None:
        return
    text = to_json(value, indent=2) + "\n"
    if str(target) == "-":
        sys.stdout.write(text)
    else:
        write_atomically(target, text)

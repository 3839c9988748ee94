"""What every command shares: argument parsing, one-sentence errors, exit codes, JSON output."""

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from .errors import JaxpendError
from .files import write_atomically

__all__ = ["emit_json", "run"]


def run(main: Callable[..., None], prog: str) -> NoReturn:
    """Parse the command line into ``main``'s parameters (tyro), call it, and exit.

    Exit code 2 and one sentence on standard error for a ``JaxpendError`` or an unusable file
    system, 130 after Ctrl-C.
    """
    import tyro

    try:
        tyro.cli(main, prog=prog, config=(tyro.conf.FlagConversionOff,))
    except JaxpendError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        where = f" {error.filename}" if error.filename else ""
        print(f"{prog}: cannot use{where}: {error.strerror or error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"{prog}: interrupted", file=sys.stderr)
        sys.exit(130)
    sys.exit(0)


def _plain(value: Any) -> Any:
    """Arrays to numbers and lists; what JSON has no number for (inf, nan) to null."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def emit_json(value: Any, target: str | Path | None) -> None:
    """Write ``value`` as JSON to standard output ("-") or, atomically, to a file; None: nowhere."""
    if target is None:
        return
    text = json.dumps(_plain(value), indent=2) + "\n"
    if str(target) == "-":
        sys.stdout.write(text)
    else:
        write_atomically(target, text)

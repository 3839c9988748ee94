"""Configurations in files and run folders on disk."""

import contextlib
import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import yaml

from . import __version__, tensorboard
from .errors import JaxpendError
from .files import to_json, write_atomically

if TYPE_CHECKING:
    from .controllers.policy import Policy

__all__ = ["RunFolder", "from_mapping", "load_config", "to_mapping"]

T = TypeVar("T")


def to_mapping(config: Any) -> dict:
    """A configuration dataclass as plain nested dicts and lists, as YAML and JSON have them.

    Infinities become text, since JSON has no number for them; ``from_mapping`` reads it back.
    """
    return json.loads(json.dumps(dataclasses.asdict(config)), parse_constant=str)


def from_mapping(default: T, values: Any, where: str) -> T:
    """``default`` with the fields named in a nested mapping replaced.

    Raises:
        JaxpendError: an unknown field, or a value of the wrong type; ``where`` names the source.
    """
    if not isinstance(values, dict):
        raise JaxpendError(f"{where}: expected fields of {type(default).__name__}")
    known = {f.name: getattr(default, f.name) for f in dataclasses.fields(default)}
    changes = {}
    for name, value in values.items():
        if name not in known:
            raise JaxpendError(f"{where}: unknown field {name!r}; known: {', '.join(known)}")
        changes[name] = _converted(known[name], value, f"{where}: {name}")
    return dataclasses.replace(default, **changes)


def _converted(old: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(old):
        return from_mapping(old, value, where)
    if isinstance(old, tuple) and isinstance(value, list):
        return tuple(value)
    if isinstance(old, float) and isinstance(value, int | str) and not isinstance(value, bool):
        # YAML takes 1e-3 for text, and the infinities of ``to_mapping`` are text.
        with contextlib.suppress(ValueError):
            return float(value)
    if old is not None and type(value) is not type(old):
        raise JaxpendError(f"{where}: {value!r} is not {type(old).__name__}")
    return value


def load_config(default: T, path: str | Path, also: Sequence[str] = ()) -> T:
    """``default`` with what a YAML file says; sections in ``also`` may be there without a field.

    Raises:
        JaxpendError: the file cannot be read, or names an unknown field or a bad value.
    """
    try:
        values = yaml.safe_load(Path(path).read_text())
    except FileNotFoundError:
        raise JaxpendError(f"there is no configuration file {path}") from None
    except (UnicodeDecodeError, yaml.YAMLError):
        raise JaxpendError(f"{path} is not valid YAML") from None
    values = {} if values is None else values
    if isinstance(values, dict):
        values = {k: v for k, v in values.items() if k not in also or hasattr(default, k)}
    return from_mapping(default, values, str(path))


class RunFolder:
    """Where a run leaves its configuration, metrics, policies and result.

    ``config.json``, ``metrics.jsonl`` (one row an evaluation), ``*.npz`` policies and, at the
    end, ``result.json``. Policies and results are written atomically.
    """

    def __init__(self, path: str | Path, config: Any, command: str):
        self.path, self.command = Path(path), command
        self._tensorboard = getattr(config, "tensorboard", False)
        self._events: tensorboard.Events | None = None
        if self._tensorboard:
            tensorboard.require()
        if (self.path / "config.json").exists():
            raise JaxpendError(
                f"{self.path} already holds a run; choose another name or remove the folder"
            )
        self.path.mkdir(parents=True, exist_ok=True)
        self.config, self.started = to_mapping(config), time.perf_counter()
        self.write_json("config.json", self.config)

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file."""
        write_atomically(self.path / name, to_json(value, indent=2) + "\n")

    def log(self, stage: str, **values: Any) -> None:
        """Append one row of metrics."""
        row = {"stage": stage, "seconds": round(time.perf_counter() - self.started, 2)}
        row |= {k: v if isinstance(v, int | str) else float(v) for k, v in values.items()}
        with (self.path / "metrics.jsonl").open("a") as file:
            file.write(to_json(row) + "\n")
        if self._events is not None:
            self._events.add(row)
        elif self._tensorboard:
            self._events = tensorboard.Events(self.path)  # of all rows, this one too

    def save(self, name: str, policy: "Policy", **provenance: Any) -> Path:
        """Write a policy file with the command and configuration that made it."""
        from .controllers.policy import save_policy  # loads jax; configurations do without

        made_by = {"command": self.command, "version": __version__, "config": self.config}
        save_policy(self.path / name, policy, provenance | made_by)
        return self.path / name

"""Run folders on disk."""

import contextlib
import fcntl
import os
import re
import time
import weakref
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from .. import __version__
from ..config_files import flat, to_mapping
from ..controller import Controller
from ..controllers.files import save_controller
from ..errors import JaxpendError
from ..files import TEMPORARY, remove_temporary, to_json, write_atomically
from . import tensorboard
from .reader import Unreadable, read_json, read_result, seed_folders

__all__ = ["RunFolder", "refuse_no_group", "refuse_other"]

# Where a run is, and how it is kept, may change when it goes on; what it computes must not.
MAY_DIFFER = (
    "run", "runs", "seeds", "vmap", "checkpoint", "on_divergence", "max_rollbacks", "tensorboard",
    "design", "devices", "hosts", "host", "coordinator",
)  # fmt: skip
INSTEAD = "choose another name or remove the folder"


def refuse_foreign(path: Path) -> None:
    """Raise ``JaxpendError`` if a folder holds files, but no run: they are a user's own."""
    if not path.is_dir() or (path / "config.json").exists():
        return
    # A process killed at the very beginning leaves no more than these.
    begun = {p for p in path.iterdir() if p.name == ".lock" or TEMPORARY.fullmatch(p.name)}
    with contextlib.suppress(Unreadable):  # not ours
        if isinstance(_object(path / "run.json").get("stages"), list):
            begun.add(path / "run.json")
    if set(path.iterdir()) - begun:
        raise JaxpendError(f"{path} is not empty and holds no run; choose another name")


def refuse_no_group(path: Path) -> None:
    """Raise ``JaxpendError`` if a folder for several seeds holds something else."""
    if not path.is_dir() or seed_folders(path):
        return
    if any(not re.fullmatch(r"seed\d+", part.name) for part in path.iterdir()):
        text = f"{path} is not empty and holds no runs of several seeds; choose another name"
        raise JaxpendError(text)


def changed(config: Any) -> dict[str, list[Any]]:
    """Fields of a run's configuration, dotted, that are not as by default: value and default."""
    same = {"robot": config.robot} if hasattr(config, "robot") else {}
    default, given = (flat(to_mapping(c)) for c in (type(config)(**same), config))
    return {k: [v, default.get(k)] for k, v in given.items() if k not in default or v != default[k]}


def _object(path: Path) -> dict[str, Any]:
    """The JSON object in a file; an empty one if there is no such file."""
    value = read_json(path) if path.exists() else {}
    if not isinstance(value, dict):
        raise Unreadable(path, "a JSON object")
    return value


def refuse_other(path: Path, config: Any, about: Mapping[str, Any]) -> None:
    """Raise ``JaxpendError`` for a folder that is no run's, or another run's: see ``RunFolder``."""
    refuse_foreign(path)
    if not (path / "config.json").exists():
        return
    try:
        made_by, written = _object(path / "run.json"), _object(path / "config.json")
        read_result(path / "result.json")
    except Unreadable as error:
        raise JaxpendError(f"{error.path} is damaged; {INSTEAD}") from None
    there = made_by.get("version", "(unknown version)")
    if there != __version__:
        text = f"{path} holds a run of jaxpend {there}, this is {__version__}; {INSTEAD}"
        raise JaxpendError(text)
    # A plant is compared by its parameters, not by the name of its file.
    stored = flat(written | {"plant": made_by.get("plant")})
    given = flat(to_mapping(config) | {"plant": about.get("plant")})
    for field in given | stored:
        there, here = stored.get(field), given.get(field)
        if there != here and field.partition(".")[0] not in MAY_DIFFER:
            text = f"{path} holds a run with {field} {to_json(there)}, not {to_json(here)}"
            raise JaxpendError(f"{text}; {INSTEAD}")


class RunFolder(contextlib.AbstractContextManager):
    """Where a run leaves its configuration, metrics, policies and result.

    ``config.json``, ``run.json`` (version, command, what differs from the defaults, and what it is
    ``about``: its stages, its plant), ``metrics.jsonl`` (one row an evaluation), ``*.npz``
    policies, ``checkpoints`` while it is not finished and, at the end, ``result.json``. All but
    the metrics are written atomically.

    A new folder is made; one with a run of the same configuration is taken up again. As long as
    this object is open, no other process can open a run in the folder that is not finished.

    Raises:
        JaxpendError: there is a run of another configuration, plant or version, or files that
            are no run, or another process works on it. Nothing in the folder has changed then.
    """

    def __init__(
        self, path: str | Path, config: Any, command: str, about: Mapping[str, Any] | None = None
    ):
        self.path, self.command, self.about = Path(path), command, about or {}
        self._metrics = self.path / "metrics.jsonl"
        self._tensorboard = getattr(config, "tensorboard", False)
        self._events: tensorboard.Events | None = None
        if self._tensorboard:
            tensorboard.require()
        self.config, self.started = to_mapping(config), time.perf_counter()
        self._close = lambda: None
        refuse_other(self.path, config, self.about)
        if self.result is None:
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock()
            refuse_other(self.path, config, self.about)  # it may have been made meanwhile
            remove_temporary(self.path)
        if not (self.path / "config.json").exists():
            made_by = {"version": __version__, "jax": version("jax"), "command": command}
            about = {"stages": [], "changed": changed(config), **self.about}
            self.write_json("run.json", {**made_by, **about})
            self.write_json("config.json", self.config)  # last: it says that a run is here

    def _lock(self) -> None:
        # The system releases it when the process ends, however it ends.
        descriptor = os.open(self.path / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        self._close, self._descriptor = weakref.finalize(self, os.close, descriptor), descriptor
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(descriptor, 20).decode() or "unknown"
            self.close()
            text = f"another process ({owner}) is working on {self.path}"
            raise JaxpendError(f"{text}; wait for it or choose another name") from None
        os.ftruncate(descriptor, 0)
        os.write(descriptor, str(os.getpid()).encode())

    def check_there(self) -> None:
        """Raise ``JaxpendError`` if the folder is no longer the one that is locked."""
        try:
            there = os.path.samestat(os.fstat(self._descriptor), os.stat(self.path / ".lock"))
        except FileNotFoundError:
            there = False
        if not there:
            text = f"{self.path} was removed or replaced while a run was in it"
            raise JaxpendError(f"{text}; the run has stopped, begin it again")

    def close(self) -> None:
        """Let other processes have the folder."""
        self._close()

    def __exit__(self, *exception):
        self.close()

    @property
    def result(self) -> dict | None:
        """What ``result.json`` says; None: the run is not finished."""
        return read_result(self.path / "result.json")

    @property
    def seconds(self) -> float:
        """Time spent on the run so far, in all processes that worked on it."""
        return round(time.perf_counter() - self.started, 2)

    def rewind(self, metrics_bytes: int = 0, seconds: float = 0.0) -> None:
        """Go back to when the metrics were this long, after so much time."""
        self.started = time.perf_counter() - seconds
        if self._metrics.exists():
            os.truncate(self._metrics, metrics_bytes)

    @property
    def metrics_bytes(self) -> int:
        """Length of the metrics on disk."""
        return self._metrics.stat().st_size if self._metrics.exists() else 0

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file."""
        write_atomically(self.path / name, to_json(value, indent=2) + "\n")

    def log(self, stage: str, **values: Any) -> None:
        """Append one row of metrics, the whole of it or nothing."""
        row = {"stage": stage, "seconds": self.seconds}
        row |= {k: v if isinstance(v, int | str) else float(v) for k, v in values.items()}
        self.check_there()
        before = self.metrics_bytes
        try:
            with self._metrics.open("a") as file:
                file.write(to_json(row) + "\n")
        except OSError:  # a full disk takes the beginning of a row
            if self.metrics_bytes > before:
                os.truncate(self._metrics, before)
            raise
        if self._events is not None:
            self._events.add(row)
        elif self._tensorboard:
            columns = {stage["name"]: stage["column"] for stage in self.about.get("stages", ())}
            self._events = tensorboard.Events(self.path, columns)  # of all rows, this one too

    def save(self, name: str, policy: Controller, **provenance: Any) -> Path:
        """Write a policy or controller file with the command and configuration that made it."""
        made_by = {"command": self.command, "version": __version__, "config": self.config}
        save_controller(self.path / name, policy, self.config["robot"], provenance | made_by)
        return self.path / name

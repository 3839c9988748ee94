"""Several processes, on one machine or many, that compute one run together.

Each runs the same command with its own number. ``join`` brings them together by
``jax.distributed``; then ``devices`` shares rows among the devices of all of them. All do the same
in the same order. The first one alone writes; the others work in a copy of the run's folder that
nobody keeps (``working_copy``).
"""

import contextlib
import io
import os
import sys
import tarfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.extend.backend import clear_backends

from .errors import JaxpendError

__all__ = ["Gone", "agreed", "check", "first", "guarded", "join", "leave", "working_copy"]

WAIT = 60  # s, for all to arrive
# s, after which JAX ends the processes that wait for one that is there but says nothing any more.
SILENCE = 50

_lost = False  # whether another one is gone
_stopping = False  # whether all stop together


class Gone(JaxpendError):
    """Another host does not answer any more."""


def check(hosts: int, host: int, coordinator: str) -> None:
    """Raise ``JaxpendError`` for numbers or an address that make no sense; see ``join``."""
    if hosts in (0, 1):
        if host or coordinator:
            text = "host and coordinator are for several hosts; give hosts, their number, too"
            raise JaxpendError(text)
        return
    if not 0 <= host < hosts:
        raise JaxpendError(f"host is {host}; of {hosts} hosts it must be in 0 to {hosts - 1}")
    name, _, port = coordinator.rpartition(":")
    if not (name and port.isdecimal() and 0 < int(port) < 65536):
        text = "it must be HOST:PORT of host 0, such as 10.0.0.1:9000"
        raise JaxpendError(f"coordinator is {coordinator!r}; {text}")


def join(hosts: int, host: int, coordinator: str) -> None:
    """Compute together with other processes from now on.

    It comes before anything is computed. Where the others do not arrive within a minute, the
    process ends here, with one sentence and exit code 2: JAX would abort it without an exception.

    Args:
        hosts: how many there are; 1: this one alone; 0: as the cluster says, whose environment
            JAX reads (Slurm, Kubernetes, MPI).
        host: the number of this one, from 0 on.
        coordinator: HOST:PORT of host 0.

    Raises:
        JaxpendError: as ``check``; something was computed already, or JAX cannot join them.
    """
    check(hosts, host, coordinator)
    if hosts == 1 or jax.distributed.is_initialized():
        return
    options: dict[str, Any] = {"initialization_timeout": 10 * WAIT}
    options["heartbeat_timeout_seconds"] = SILENCE
    if hosts:
        options |= {"coordinator_address": coordinator, "num_processes": hosts, "process_id": host}
    late = threading.Timer(WAIT, _give_up, (f"not all hosts are here after {WAIT} s",))
    late.daemon = True
    late.start()
    clear_backends()  # who looked whether a platform is there has begun one
    try:
        jax.distributed.initialize(**options)
    except (RuntimeError, ValueError) as error:
        said = (str(error).strip() or "no reason given").splitlines()[0]
        raise JaxpendError(f"jax cannot join the hosts: {said}") from None
    finally:
        late.cancel()


def _give_up(why: str) -> None:
    print(f"jaxpend: {why}", file=sys.stderr, flush=True)
    os._exit(2)


def first() -> bool:
    """Whether this process is the one that writes; alone it is."""
    return jax.process_index() == 0


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Inside, a host that is gone is a ``Gone`` and not an error of JAX's own."""
    global _lost
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if jax.process_count() == 1 or "Gloo" not in str(error):
            raise
        _lost = True
        raise Gone("another host is gone") from None


def leave(code: int) -> None:
    """End the process, unless all stop together: JAX would wait for the others, then abort."""
    if _lost or (not _stopping and jax.distributed.is_initialized()):
        if sys.stderr is not None:
            sys.stderr.flush()
        os._exit(code)


def agreed(asked: bool) -> bool:
    """Whether any host is asked to stop, so that all do."""
    global _stopping
    if jax.process_count() == 1:
        return asked
    from jax.experimental.multihost_utils import process_allgather

    with guarded():
        _stopping = bool(np.asarray(process_allgather(np.asarray(asked))).any())
    return _stopping


def working_copy(folder: Path, copy: Path) -> Path:
    """Where this process works: the first in the folder itself, the others in a copy of it.

    What the first host has there, if anything, is in ``copy`` then.
    """
    if jax.process_count() == 1:
        return folder
    from jax.experimental.multihost_utils import broadcast_one_to_all

    packed = io.BytesIO()
    if first() and folder.is_dir():
        with tarfile.open(fileobj=packed, mode="w") as archive:
            archive.add(folder, ".", filter=lambda entry: None if ".lock" in entry.name else entry)
    content = np.frombuffer(packed.getvalue(), np.uint8)
    with guarded():
        size = int(broadcast_one_to_all(np.asarray(len(content))))
        padded = content if first() else np.zeros(size, np.uint8)
        content = np.asarray(broadcast_one_to_all(padded)) if size else padded
    if first():
        return folder
    if size:
        with tarfile.open(fileobj=io.BytesIO(content.astype(np.uint8).tobytes())) as archive:
            archive.extractall(copy, filter="data")
    return copy

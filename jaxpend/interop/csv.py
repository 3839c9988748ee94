"""Recorded trajectories as CSV, in the layout of the RealAIGym ``double_pendulum`` package.

A row holds a time stamp (s), angles (rad), velocities (rad/s) and torques (N m). Simulated and
measured runs of the boards name them ``time, pos_meas1, pos_meas2, vel_meas1, vel_meas2,
tau_con1, tau_con2``, planned trajectories ``time, pos1, pos2, vel1, vel2, tau1, tau2``; the order
does not matter, and what else there is (filtered states, gains, ...) is passed over.
"""

import csv
import io
from pathlib import Path

import numpy as np

from ..errors import JaxpendError
from ..files import write_atomically
from ..rollout import Trajectory

__all__ = ["check_target", "load_csv", "save_csv"]

MEASURED = ("pos_meas1", "pos_meas2", "vel_meas1", "vel_meas2", "tau_con1", "tau_con2")
PLANNED = ("pos1", "pos2", "vel1", "vel2", "tau1", "tau2")
HEADER = ",".join(("time", *MEASURED))
LARGEST = 256 * 2**20  # bytes; ten seconds at 500 Hz are one megabyte


def load_csv(path: str | Path) -> Trajectory:
    """The trajectory in a file, as numpy arrays in float64: as many states (N, 4) as torques.

    What the controller measured and asked for is not known beyond that: ``x_measured`` is ``x``,
    and ``u_command`` is ``u``.

    Raises:
        JaxpendError: no such file, columns that are missing, a row of another length, anything
            that is no finite number, fewer than three rows, or time that goes backwards.
    """
    rows = _rows(path)
    blank = next((place for place, row in enumerate(rows) if any(map(str.strip, row))), 0)
    rows = rows[blank:]
    names = [name.strip() for name in rows[0]] if rows else []
    if not names:
        raise JaxpendError(f"{path} is empty; it must have the columns {HEADER}")
    lacking = {kind: [n for n in ("time", *kind) if n not in names] for kind in (MEASURED, PLANNED)}
    kind = min(lacking, key=lambda kind: len(lacking[kind]))
    if lacking[kind]:
        raise JaxpendError(
            f"{path} has no column {', '.join(lacking[kind])}; it must have the columns {HEADER}"
        )
    if twice := [name for name in ("time", *kind) if names.count(name) > 1]:
        raise JaxpendError(f"{path} has the column {twice[0]} twice; which one counts is not clear")
    columns = [names.index(name) for name in ("time", *kind)]
    numbers = [
        _numbers(path, line, row, names, columns)
        for line, row in enumerate(rows[1:], blank + 2)
        if row
    ]
    if len(numbers) < 3:
        count = len(numbers)
        raise JaxpendError(f"{path} holds {count} samples; a trajectory has three or more")
    table = np.array(numbers)
    t, x, u = table[:, 0], table[:, 1:5], table[:, 5:7]
    if (back := np.flatnonzero(np.diff(t) < 0)).size:
        k = int(back[0])
        raise JaxpendError(f"{path}: time goes back from {t[k]} s to {t[k + 1]} s")
    return Trajectory(t=t, x=x, u=u, x_measured=x, u_command=u)  # type: ignore[arg-type]


def _rows(path: str | Path) -> list[list[str]]:
    """The fields of all lines."""
    try:
        with Path(path).open("rb") as file:
            content = file.read(LARGEST + 1)
    except OSError as error:
        raise JaxpendError(f"cannot read {path}: {error.strerror}") from None
    if len(content) > LARGEST:
        raise JaxpendError(f"{path} is larger than {LARGEST // 2**20} MiB; it is no trajectory")
    try:
        return list(csv.reader(io.StringIO(content.decode("utf-8-sig"), newline="")))
    except (UnicodeDecodeError, csv.Error):
        raise JaxpendError(f"{path} is no CSV: it is not text with commas") from None


def _numbers(
    path: str | Path, line: int, row: list[str], names: list[str], columns: list[int]
) -> list[float]:
    """The wanted columns of a row."""
    if len(row) != len(names):
        text = f"{path}, line {line} has {len(row)} values for {len(names)} columns"
        raise JaxpendError(f"{text}; it may be cut off")
    numbers = []
    for column in columns:
        try:
            number = float(row[column])
        except ValueError:
            number = np.nan
        if not np.isfinite(number):
            text = f"{path}, line {line}: {names[column]} is {row[column].strip()[:40]!r}"
            raise JaxpendError(f"{text}; it must be a finite number")
        numbers.append(number)
    return numbers


def check_target(path: str | Path) -> None:
    """Raise ``JaxpendError`` if a file is there that ``save_csv`` did not write."""
    there = Path(path)
    if str(path) == "-":
        raise JaxpendError("a trajectory is written to a file; - is none")
    if there.is_file() and there.stat().st_size:
        with there.open("rb") as file:
            first, row = file.readline(1000).strip(), file.readline(1000).strip()
            if first != HEADER.encode() or not _is_ours(row):
                raise JaxpendError(f"{path} is not a trajectory of jaxpend; name another file")


def _is_ours(row: bytes) -> bool:
    """Whether ``save_csv`` wrote a row, in as few digits as its numbers need; others do not."""
    try:
        return row == b",".join(b"%.17g" % float(number) for number in row.split(b","))
    except ValueError:
        return False


def save_csv(path: str | Path, run: Trajectory) -> None:
    """Write a trajectory as the boards keep simulated ones: true states, applied torques.

    Numbers are written so that reading them gives the same ones. As there, the state after the
    last torque is left out.

    Raises:
        JaxpendError: a file is there that is no such trajectory, or the run is a batch.
    """
    check_target(path)
    u = np.asarray(run.u, float)
    if u.ndim != 2 or u.shape[1] != 2:
        raise JaxpendError(f"the torques have shape {u.shape}; a file holds one run, (N, 2)")
    t, x = np.asarray(run.t, float)[: len(u)], np.asarray(run.x, float)[: len(u)]
    lines = io.StringIO()
    np.savetxt(lines, np.column_stack([t, x, u]), "%.17g", ",", header=HEADER, comments="")
    write_atomically(path, lines.getvalue())

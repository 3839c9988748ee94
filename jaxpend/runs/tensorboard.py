"""The metrics of a run as TensorBoard events; needs the package tensorboardX."""

import contextlib
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import JaxpendError
from .reader import read_rows

__all__ = ["Events", "require"]

SUFFIX = ".jaxpend"  # of the event files that are ours


def require() -> None:
    """Raise ``JaxpendError`` if the package is not installed."""
    try:
        import tensorboardX  # noqa: F401
    except ImportError:
        text = "tensorboard needs the package tensorboardX: pip install 'jaxpend[tensorboard]'"
        raise JaxpendError(text) from None


class Events:
    """Scalars STAGE/NAME over the steps of the stage, in ``RUN/tensorboard``.

    They are made anew from the metrics on disk, so that a run that goes on from a checkpoint has no
    row twice. Every row is on disk when ``add`` returns (``SummaryWriter`` would leave that to a
    thread and lose the last ones).

    Args:
        run: the run folder.
        columns: name of a stage -> the column of its metrics that counts its steps.
    """

    def __init__(self, run: Path, columns: Mapping[str, str]):
        from tensorboardX.event_file_writer import EventsWriter

        folder, self.columns = run / "tensorboard", columns
        folder.mkdir(exist_ok=True)
        for path in folder.glob(f"events.out.tfevents.*{SUFFIX}"):
            path.unlink()
        self._writer = EventsWriter(str(folder / "events"), SUFFIX)
        weakref.finalize(self, self._writer.close)
        for row in read_rows(run / "metrics.jsonl"):
            with contextlib.suppress(KeyError):  # of no stage
                self.add(row)

    def add(self, row: Mapping[str, Any]) -> None:
        """Write one row of metrics; what is not a number is left out."""
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.summary import scalar

        column = self.columns[row["stage"]]
        for name, value in row.items():
            if isinstance(value, int | float) and name not in ("seconds", column):
                summary = scalar(f"{row['stage']}/{name}", value)
                event = Event(wall_time=time.time(), step=row[column], summary=summary)
                self._writer.write_event(event)
        self._writer.flush()

"""TensorBoard events: the rows of the metrics, each once."""

import json
import sys

import pytest
from training_runs import events_of

from jaxpend import JaxpendError
from jaxpend.config import SNESRun
from jaxpend.runs.folder import RunFolder
from jaxpend.runs.tensorboard import Events

ROWS = [
    {"stage": "sac", "seconds": 0.5, "env_steps": 64, "updates": 8, "score": 0.25, "loss": None},
    {"stage": "sac", "seconds": 1.5, "env_steps": 128, "updates": 16, "score": 0.5, "loss": 2.0},
    {"stage": "snes", "seconds": 2.5, "generation": 2, "mean_fitness": 0.75},
    {"stage": "climb", "seconds": 3.5, "metres": 7, "score": 0.5},  # a stage of one's own
]
COLUMNS = {"sac": "env_steps", "snes": "generation", "climb": "metres"}
SCALARS = [
    ("sac/updates", 64, 8.0), ("sac/score", 64, 0.25),
    ("sac/updates", 128, 16.0), ("sac/score", 128, 0.5), ("sac/loss", 128, 2.0),
    ("snes/mean_fitness", 2, 0.75), ("climb/score", 7, 0.5),
]  # fmt: skip


def write(run, rows):
    """Rows of metrics as training leaves them."""
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def test_every_row_is_on_disk_once_whatever_went_before(tmp_path):
    write(tmp_path, ROWS[:2])
    events = Events(tmp_path, COLUMNS)
    assert events_of(tmp_path) == SCALARS[:5]
    for row in ROWS[2:]:
        events.add(row)
    assert events_of(tmp_path) == SCALARS
    (path,) = (tmp_path / "tensorboard").iterdir()
    path.rename(path.with_name("events.out.tfevents.1.before.jaxpend"))
    own = tmp_path / "tensorboard" / "events.out.tfevents.1.mine"
    own.write_text("mine")
    write(tmp_path, ROWS[:1])  # killed, and taken up again from an older checkpoint
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('[]\n{"stage": "other", "at": 3}\n{"stage": "sac"}\n{"sta')
    events = Events(tmp_path, COLUMNS)
    for row in ROWS[1:]:
        events.add(row)
    assert events_of(tmp_path) == SCALARS
    assert own.read_text() == "mine"


def test_a_run_folder_writes_events_only_if_asked(tmp_path):
    config = SNESRun(tensorboard=True)
    about = {"stages": [{"name": name, "column": column} for name, column in COLUMNS.items()]}
    folder = RunFolder(tmp_path / "asked", config, "command", about)
    for row in ROWS:
        folder.log(**{name: value for name, value in row.items() if value is not None})
    assert events_of(folder.path) == SCALARS
    folder = RunFolder(tmp_path / "not", SNESRun(), "command")
    folder.log(**ROWS[2])
    assert not (folder.path / "tensorboard").exists()


def test_a_missing_package_is_one_sentence_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(JaxpendError, match=r"pip install 'jaxpend\[tensorboard\]'"):
        RunFolder(tmp_path / "run", SNESRun(tensorboard=True), "command")
    assert not list(tmp_path.iterdir())

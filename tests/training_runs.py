"""``python -m jaxpend.train`` at its smallest: many small chunks in every stage."""

import contextlib
import json
import os
import signal
import struct
import subprocess
import sys

import numpy as np

RECIPE = "demonstrated_pendubot"
OPTIONS = f"""
    --config {RECIPE} --seed 3 --run run --sac.steps 1024 --sac.eval-every 64 --sac.num-envs 8
    --sac.batch-size 32 --sac.replay-capacity 128 --sac.critic-hidden 8 --sac.actor-hidden 8
    --sac.env.observation.history 2 --sac.env.randomised 0.5
    --sac.demonstrations.episodes 2 --sac.demonstrations.duration 1
    --sac.demonstrations.updates 6_000 --sac.demonstrations.batch-size 32
    --guard.no-rescue --snes.generations 6 --snes.population 4 --snes.chunk 1
""".split()


@contextlib.contextmanager
def training(folder, *options):
    """A process that trains in ``folder``/run; it is killed, and its pipes closed, at the end."""
    line = [sys.executable, "-m", "jaxpend.train", *OPTIONS, "--runs", folder, *options]
    # The processes of a session compile once.
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str(folder.parent / "compiled"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    # Children can be interrupted, even if these tests run in the background of a shell.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    pipe, environment = subprocess.PIPE, os.environ | cache
    with subprocess.Popen(
        list(map(str, line)), stdout=pipe, stderr=pipe, text=True, env=environment
    ) as process:
        signal.signal(signal.SIGINT, before)
        try:
            yield process
        finally:
            process.kill()


def rows_of(folder, stage=None):
    """Rows of the metrics, of one stage or all, without the time; no row that is half written."""
    path = folder / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    rows = [json.loads(line) for line in lines if line.endswith("\n")]
    rows = [{k: v for k, v in row.items() if k != "seconds"} for row in rows]
    return [row for row in rows if stage in (None, row["stage"])]


def result_of(folder):
    """The result, without the time."""
    result = json.loads((folder / "result.json").read_text())
    for stage in {"sac", "openings", "gradient", "snes"} & result.keys():
        del result[stage]["seconds"]
    return result


def arrays_of(path):
    """The arrays of a policy file."""
    with np.load(path) as file:
        return {name: file[name] for name in file if name != "header"}


def events_of(run):
    """(tag, step, value) of every scalar in the one event file that a run has written."""
    from tensorboardX.proto.event_pb2 import Event

    (path,) = (run / "tensorboard").glob("*.jaxpend")
    data, found = path.read_bytes(), []
    while data:  # TFRecord: length, its checksum, the event, its checksum
        (size,) = struct.unpack("<Q", data[:8])
        event, data = Event.FromString(data[12 : 12 + size]), data[16 + size :]
        found += [(value.tag, event.step, value.simple_value) for value in event.summary.value]
    return found

"""Several processes that train one run together, over loopback."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused

from jaxpend import hosts, save_policy
from jaxpend.controllers.policy import Policy

SETTINGS = ("--snes.chunk", "2", "--snes.population", "6", "--devices", "1")


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A small network, in a file."""
    draw = np.random.default_rng(0)
    layers = [(draw.normal(size=(a, b)) / a**0.5, np.zeros(b)) for a, b in ((6, 8), (8, 1))]
    layers = tuple((jnp.asarray(w, "f4"), jnp.asarray(b, "f4")) for w, b in layers)
    path = tmp_path_factory.mktemp("policy") / "policy.npz"
    save_policy(path, Policy(layers, jnp.asarray(3.0)), {"robot": "pendubot"})
    return path


@pytest.fixture
def start(policy, tmp_path):
    """Starts a training of a name in ``tmp_path``; all are ended with the test."""
    begun = []

    def of(name, generations, *more):
        line = [sys.executable, "-m", "jaxpend", "snes", "--robot", "pendubot"]
        line += ["--policy", str(policy), "--snes.generations", str(generations), *SETTINGS]
        line += ["--runs", str(tmp_path), "--run", name, *more]
        # They can be interrupted, even if these tests run in the background of a shell.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        begun.append(subprocess.Popen(line, stderr=subprocess.PIPE, text=True))
        signal.signal(signal.SIGINT, before)
        return begun[-1]

    yield of
    for process in begun:
        process.kill()
        process.communicate()


def together(start, name, generations):
    """Two processes, numbers 0 and 1."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        where = f"localhost:{free.getsockname()[1]}"
    line = ("--hosts", "2", "--coordinator", where, "--host")
    return [start(name, generations, *line, str(number)) for number in (0, 1)]


def rows(folder):
    path = folder / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_two_hosts_train_as_one_does_and_the_first_alone_writes(start, tmp_path):
    both = together(start, "both", 4)
    said = [process.communicate(timeout=240)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert "after SNES" in said[0]
    assert "SNES" not in said[1]
    alone = start("alone", 4)
    assert alone.communicate(timeout=240)
    assert alone.returncode == 0
    assert {path.name for path in tmp_path.iterdir()} == {"both", "alone"}
    names = [{path.name for path in (tmp_path / run).iterdir()} for run in ("both", "alone")]
    assert names[0] == names[1]
    for one, other in zip(*(rows(tmp_path / run) for run in ("both", "alone")), strict=True):
        assert one["generation"] == other["generation"]
        for name in ("mean_fitness", "max_fitness", "sigma"):
            assert one[name] == pytest.approx(other[name], abs=2e-3), name


def test_a_host_that_dies_ends_the_run_and_everything_is_on_disk(start, tmp_path):
    first, second = together(start, "run", 100_000)
    deadline = time.monotonic() + 240
    while len(rows(tmp_path / "run")) < 2:
        assert time.monotonic() < deadline
        assert first.poll() is None
        time.sleep(0.1)
    second.kill()
    said = first.communicate(timeout=60)[1]
    assert first.returncode == 2
    assert "jaxpend snes: another host is gone; everything is in" in said
    there = rows(tmp_path / "run")[-1]["generation"]
    alone = start("run", 100_000)
    for line in alone.stderr:
        if "resuming" in line:
            break
    assert f"at {there:,} of 100,000 generations" in line.replace("\n", " ")
    alone.send_signal(signal.SIGINT)
    alone.communicate(timeout=240)
    assert alone.returncode == 130


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((1, 1, ""), "host and coordinator are for several hosts"),
        ((1, 0, "a:1"), "host and coordinator are for several hosts"),
        ((0, 1, ""), "host and coordinator are for several hosts"),
        ((2, 2, "a:1"), "host is 2; of 2 hosts it must be in 0 to 1"),
        ((2, 0, ""), "coordinator is ''; it must be HOST:PORT of host 0"),
        ((2, 0, "a"), "coordinator is 'a'; it must be HOST:PORT"),
        ((2, 0, "a:b"), "coordinator is 'a:b'; it must be HOST:PORT"),
        ((2, 0, ":9000"), "coordinator is ':9000'; it must be HOST:PORT"),
        ((2, 0, "a:70000"), "coordinator is 'a:70000'; it must be HOST:PORT"),
    ],
)
def test_numbers_and_addresses_that_make_no_sense_are_refused(given, words):
    with refused(words):
        hosts.join(*given)


def test_alone_nothing_changes(tmp_path):
    hosts.join(1, 0, "")
    assert hosts.first()
    assert [hosts.agreed(asked) for asked in (False, True)] == [False, True]
    assert hosts.working_copy(tmp_path, tmp_path / "copy") == tmp_path
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize(
    ("joined", "lost", "stopping", "ends"),
    [
        (False, False, False, False),
        (True, False, False, True),  # it failed, or was interrupted alone
        (True, False, True, False),
        (True, True, True, True),
    ],
)
def test_who_fails_does_not_wait_for_the_others(monkeypatch, joined, lost, stopping, ends):
    ended = []
    monkeypatch.setattr(os, "_exit", ended.append)
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: joined)
    monkeypatch.setattr(hosts, "_lost", lost)
    monkeypatch.setattr(hosts, "_stopping", stopping)
    hosts.leave(130)
    assert ended == ([130] if ends else [])

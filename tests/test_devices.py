"""Several devices: the same numbers as one of them, up to rounding, whatever they share."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import refused

from jaxpend import cli, devices

SCRIPT = Path(__file__).parent / "on_devices.py"


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=8"
    done = subprocess.run(
        [sys.executable, SCRIPT, tmp_path_factory.mktemp("devices")],
        env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("what", ["split", "sweep", "doors", "windows", "sac"])
def test_any_number_of_devices_computes_the_same(found, what):
    for count in {"3", "8"} & {n for n, parts in found.items() if what in parts}:
        one, many = (np.hstack(found[n][what]) for n in ("1", count))
        assert len(np.unique(one)) > 1
        # Times at which an arm that falls crosses the line are among what is behind the doors.
        np.testing.assert_allclose(many, one, rtol=1e-2 if what == "doors" else 2e-3, atol=2e-4)


def test_what_calls_python_has_one_state_at_a_time(found):
    np.testing.assert_array_equal(found["8"]["python"], found["1"]["python"])


def test_devices_share_the_updates_of_sac(found):
    assert (found["1"]["exchanged"], found["8"]["exchanged"]) == (False, True)


def test_the_cores_are_devices_since_no_import_computes():
    code = (
        "import os, jaxpend.train, jaxpend.report, jaxpend.leaderboard, jaxpend.interop\n"
        "from jaxpend.cli.cache import share_processor\n"
        "share_processor()\n"
        "import jax\n"
        "known = hasattr(os, 'sched_getaffinity')\n"
        "cores = len(os.sched_getaffinity(0)) if known else os.cpu_count()\n"
        "assert jax.device_count() == min(cores, 32)\n"
    )
    if "host_platform_device_count" in os.environ["XLA_FLAGS"]:
        pytest.skip("XLA_FLAGS says how many devices there are")
    subprocess.run([sys.executable, "-c", code], check=True)


def test_more_devices_than_there_are_is_one_sentence(monkeypatch, capsys):
    with refused("devices is 99; jax has 1 here, and XLA_FLAGS=--xla_force_host"):
        devices.use(99)
    for command in ("robustness", "hardware", "leaderboard", "train"):
        monkeypatch.setattr("sys.argv", ["jaxpend", command, "--devices", "99"])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        assert stop.value.code == 2
        assert "devices is 99; jax has 1 here" in capsys.readouterr().err

"""What ``jaxpend runs`` reads from run folders in every state."""

import fcntl
import json
import os
import statistics

import pytest

from jaxpend import JaxpendError, cli
from jaxpend.runs.reader import listing

CONFIG = {
    "robot": "acrobot", "seed": 3, "snes": {"generations": 1000},
    "sac": {"steps": 100, "demonstrations": {"updates": 4000}},
}  # fmt: skip


def make(folder, rows=(), result=None, config=CONFIG):
    """A run folder as training leaves it."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if result is not None:
        (folder / "result.json").write_text(json.dumps(result))
    return folder


SAC = [
    {"stage": "sac", "seconds": 1.5, "env_steps": 50},
    {"stage": "sac", "seconds": 2.5, "env_steps": 100},
]
SNES = [*SAC, {"stage": "snes", "seconds": 9.25, "generation": 1000}]


@pytest.fixture
def runs(tmp_path):
    """A folder with a run in every state, and things that are none."""
    make(tmp_path / "done", SNES, {"score": 0.5})
    make(tmp_path / "half", SAC[:1])
    make(tmp_path / "imitates", [{"stage": "imitation", "seconds": 1.0, "updates": 2000}])
    make(tmp_path / "new", config={"robot": "pendubot", "seed": 0, "snes": {"generations": 3}})
    cut = make(tmp_path / "cut", SNES)
    with (cut / "metrics.jsonl").open("a") as file:
        file.write('{"stage": "snes", "gener')
    make(tmp_path / "bad-result", SNES).joinpath("result.json").write_text('{"score": 0.')
    make(tmp_path / "bad-config").joinpath("config.json").write_text("{")
    make(tmp_path / "foreign", config=["no", "run"])
    (tmp_path / "robustness").mkdir()
    (tmp_path / "file").write_text("")
    return tmp_path


def test_every_state_is_told_apart(runs):
    entries = {run["run"]: run for run in listing(runs)}
    said = {name: (run["state"], run["at"], run["score"]) for name, run in entries.items()}
    assert said == {
        "bad-config": ("broken", "config.json", None),
        "bad-result": ("broken", "result.json", None),
        "cut": ("interrupted", "SNES 1,000/1,000", None),
        "done": ("finished", None, 0.5),
        "foreign": ("broken", "config.json", None),
        "half": ("interrupted", "SAC 50/100", None),
        "imitates": ("interrupted", "imitation 2,000/4,000", None),
        "new": ("interrupted", "the start", None),
    }
    done = entries["done"]
    assert (done["robot"], done["seed"], done["stages"]) == ("acrobot", 3, ["sac", "snes"])
    assert (done["seconds"], entries["new"]["stages"]) == (9.25, ["snes"])


def test_a_run_that_a_process_has_locked_is_running(runs):
    with (runs / "half" / ".lock").open("w+") as lock:
        lock.write(str(os.getpid()))
        lock.flush()
        state = lambda: {run["run"]: run["state"] for run in listing(runs)}["half"]  # noqa: E731
        assert state() == "interrupted"
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert state() == "running"
    assert state() == "interrupted"  # the lock file stays when its process is gone


def test_a_group_of_seeds_is_one_row_with_the_median(tmp_path):
    scores = {0: 0.1, 2: 0.7, 10: 0.3}
    for seed, score in scores.items():
        make(tmp_path / "many" / f"seed{seed}", SNES, {"score": score}, CONFIG | {"seed": seed})
    (group,) = listing(tmp_path)
    assert (group["run"], group["seed"], group["state"]) == ("many", [0, 2, 10], "finished")
    assert (group["at"], group["seconds"]) == (None, 3 * 9.25)
    assert group["score"] == statistics.median(scores.values())
    assert [run["score"] for run in group["runs"]] == list(scores.values())
    make(tmp_path / "many" / "seed11", SAC, config=CONFIG | {"seed": 11})
    (group,) = listing(tmp_path)
    assert (group["state"], group["at"]) == ("interrupted", "3 of 4 seeds")
    assert group["score"] == 0.3


def command(monkeypatch, capsys, *arguments):
    """Exit code, standard output and standard error of ``jaxpend runs``."""
    monkeypatch.setattr("sys.argv", ["jaxpend", "runs", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    return exit_.value.code, *capsys.readouterr()


def test_the_command_prints_a_table_or_json(runs, monkeypatch, capsys):
    code, out, err = command(monkeypatch, capsys, runs, "--json", "-")
    assert (code, json.loads(out), err) == (0, listing(runs), "")
    code, out, err = command(monkeypatch, capsys, runs)
    assert (code, out) == (0, "")
    (row,) = [line.split() for line in err.splitlines() if "done" in line]
    assert row[:6] == ["done", "acrobot", "SAC,", "SNES", "3", "finished"]
    assert row[6:9] == ["0.5000", "9", "s"]


@pytest.mark.parametrize("name", ["nothing", "empty"])
def test_a_folder_without_runs_is_one_sentence(tmp_path, monkeypatch, capsys, name):
    (tmp_path / "empty" / "robustness").mkdir(parents=True)
    code, out, err = command(monkeypatch, capsys, tmp_path / name)
    words = {"nothing": "there is no folder", "empty": "there are no runs in"}[name]
    assert (code, out) == (2, "")
    assert err == f"jaxpend runs: {words} {tmp_path / name}; jaxpend train makes runs\n"
    with pytest.raises(JaxpendError, match=words):
        listing(tmp_path / name)

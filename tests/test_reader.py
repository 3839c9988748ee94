"""What ``jaxpend runs`` reads from run folders in every state."""

import fcntl
import json
import os
import statistics
import subprocess
import sys

import pytest
from conftest import refused

from jaxpend import JaxpendError, cli
from jaxpend.cli.tables import runs_table
from jaxpend.files import to_json
from jaxpend.runs.reader import listing, read_run, remarks

STAGES = [
    {"name": "imitation", "title": "Imitation", "unit": "updates", "column": "updates",
     "total": 4000, "heading": "", "charts": [], "scores": []},
    {"name": "sac", "title": "SAC", "unit": "steps", "column": "env_steps", "total": 100,
     "heading": "after SAC", "charts": [["Score", {"now": "score"}, "v2 score", False]],
     "scores": ["score"]},
    {"name": "climb", "title": "Climbing", "unit": "metres", "column": "metres", "total": 1000,
     "heading": "after climbing", "charts": [], "scores": ["height"]},
]  # fmt: skip
CONFIG = {
    "robot": "acrobot", "seed": 3, "sac": {"steps": 100, "demonstrations": {"updates": 4000}},
    "snes": {"generations": 1000},
}  # fmt: skip


def make(folder, rows=(), result=None, config=CONFIG, stages=None):
    """A run folder as training leaves it; without stages, as version 0.1 left it."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if stages is not None:
        (folder / "run.json").write_text(json.dumps({"version": "0.2.0", "stages": stages}))
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
        "imitates": ("interrupted", "Imitation 2,000/4,000", None),
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


CLIMB = [*SAC, {"stage": "climb", "seconds": 9.25, "metres": 250, "height": 0.5, "note": "high"}]


def test_what_a_run_says_of_its_stages_is_believed(tmp_path):
    result = {"start": {"score": 0.1}, "sac": {"score": 0.2}, "climb": {"score": 0.5}, "score": 0.5}
    make(tmp_path / "half", CLIMB, stages=STAGES)
    make(tmp_path / "done", CLIMB, result, stages=STAGES)
    done, half = listing(tmp_path)
    assert (half["at"], half["stages"]) == ("Climbing 250/1,000", ["sac", "climb"])
    assert (done["score"], done["seconds"]) == (0.5, 9.25)
    run = read_run(tmp_path / "half")
    assert run.progress == {"imitation": (0, 4000), "sac": (100, 100), "climb": (250, 1000)}
    assert "Imitation is at 0 of 4,000 updates" in remarks([run])[0]
    assert "Climbing is at 250 of 1,000 metres" in remarks([run])[0]
    assert run.stages[1].charts == (("Score", {"now": "score"}, "v2 score", False),)
    results = read_run(tmp_path / "done").results
    assert list(results) == ["start", "after SAC", "after climbing"]
    assert results["after climbing"] == {"score": 0.5}


def test_the_best_policy_is_that_of_the_last_stage(tmp_path):
    folder = make(tmp_path / "half", CLIMB, stages=STAGES)
    assert read_run(folder).policy is None
    for name in ("sac_best.npz", "climb_best.npz", "policy.npz"):
        (folder / name).touch()
        assert read_run(folder).policy == str(folder / name)


OLD = [
    {"stage": "imitation", "seconds": 1.0, "updates": 4000, "loss": 0.1},
    {"stage": "sac", "seconds": 2.5, "env_steps": 50, "updates": 7, "score": 0.1, "uptime": 2.0},
    {"stage": "sac", "seconds": 3.5, "env_steps": 100, "updates": 9, "score": 0.2, "reward": 1.0},
    {"stage": "snes", "seconds": 9.25, "generation": 10, "mean_fitness": 0.1, "mean_score": 0.3},
]


def test_runs_of_version_0_1_can_be_read(tmp_path):
    config = json.loads(json.dumps(CONFIG))
    config["sac"]["demonstrations"]["episodes"] = 3
    config |= {"gradient": {"steps": 0, "learning_rate": 1e-4}, "guard": {"after": 2.0}}
    stage = {"robot": "acrobot", "score": 0.25, "success": False, "criteria": {}, "seconds": 3.0}
    result = {"robot": "acrobot", "seed": 3, "sac": stage, "score": 0.5}
    result["snes"] = stage | {"score": 0.5, "success": True, "criteria": {"swingup_time": 2.0}}
    folder = make(tmp_path / "old", OLD, result, config)
    about = {"version": "0.1.0", "jax": "0.10.2", "command": "jaxpend train --seed 3"}
    (folder / "run.json").write_text(json.dumps(about))
    run = read_run(folder)
    assert run.made_by == about
    assert run.progress == {"imitation": (4000, 4000), "sac": (100, 100), "snes": (10, 1000)}
    assert list(run.results) == ["after SAC", "after SNES"]
    _, sac, snes = run.stages
    assert (sac.column, sac.scores, snes.scores) == ("env_steps", ("score",), ("mean_score",))
    columns = [list(curves.values()) for _, curves, _, _ in sac.charts]
    assert columns == [["updates"], ["score"], ["uptime"], ["reward"]]
    (entry,) = listing(tmp_path)
    assert (entry["state"], entry["score"]) == ("finished", 0.5)
    (folder / "result.json").unlink()
    assert listing(tmp_path)[0]["at"] == "SNES 10/1,000"


JUNK = [None, 3, -1e400, "text", [], [[1]], {}, {"a": {"b": [None]}}, True, 10**400]


def spoilt(value):
    """A JSON value with every part of it, one after the other, replaced by junk or left out."""
    yield from JUNK
    if isinstance(value, dict):
        for name, part in value.items():
            yield {k: v for k, v in value.items() if k != name}
            yield from (value | {name: bad} for bad in spoilt(part))
    if isinstance(value, list):
        for k, part in enumerate(value[:2]):
            yield from ([*value[:k], bad, *value[k + 1 :]] for bad in spoilt(part))


RESULT = {
    "robot": "acrobot", "seed": 3, "score": 0.5,
    "sac": {"score": 0.5, "success": True, "criteria": {"swingup_time": 1.0}, "seconds": 2.0},
}  # fmt: skip
CONTENT = {
    "config.json": CONFIG,
    "run.json": {"version": "0.2.0", "command": "c", "stages": STAGES[:2]},
    "result.json": RESULT,
    "metrics.jsonl": CLIMB[0] | {"score": 0.5, "finite": 1, "rollbacks": 2},
}


@pytest.mark.parametrize("name", CONTENT)
def test_files_of_wrong_types_break_no_more_than_their_run(tmp_path, name):
    folder = make(tmp_path / "spoilt", SAC, RESULT, stages=STAGES[:2])
    make(tmp_path / "good", SAC, RESULT, stages=STAGES[:2])
    for bad in spoilt(CONTENT[name]):
        (folder / name).write_text(json.dumps(bad) + "\n")
        good, entry = listing(tmp_path)
        assert good["state"] == "finished"
        runs_table([entry, good])
        json.loads(to_json([entry]), parse_constant=pytest.fail)
        if entry["state"] == "broken":
            assert (entry["at"], entry["score"]) == (name, None)
            with refused(f"{folder / name} is not"):
                read_run(folder)
            continue
        run = read_run(folder)
        assert entry["state"] == ("finished" if run.result else "interrupted"), bad
        remarks([run])
        assert all(isinstance(result["score"], int | float) for result in run.results.values())
        for row in run.rows:
            assert all(k == "stage" or isinstance(v, int | float) for k, v in row.items())


@pytest.mark.parametrize("name", CONTENT)
@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[" * 100_000, b"9" * 5000, b"{}"])
def test_files_that_are_no_json_break_no_more_than_their_run(tmp_path, name, content):
    folder = make(tmp_path / "spoilt", SAC, stages=STAGES[:2])
    make(tmp_path / "good", SAC, RESULT, stages=STAGES[:2])
    (folder / name).write_bytes(content)
    (folder / "dangling").symlink_to(tmp_path / "nothing")
    good, entry = listing(tmp_path)
    assert good["state"] == "finished"
    harmless = name == "metrics.jsonl" or (name, content) == ("run.json", b"{}")
    assert entry["state"] == ("interrupted" if harmless else "broken")


@pytest.mark.parametrize("content", ["", "0", "-1", "text", "9" * 30])
def test_a_lock_of_nobody_is_no_lock(tmp_path, content):
    (make(tmp_path / "run", SAC) / ".lock").write_text(content)
    assert listing(tmp_path)[0]["state"] == "interrupted"


def test_folders_of_any_name_can_be_listed(tmp_path):
    names = {"²", "2", "10", "a²", "a10", "[bold]", "x"}
    for name in names:
        make(tmp_path / name, SAC)
    assert {run["run"] for run in listing(tmp_path)} == names
    runs_table(listing(tmp_path))


def test_runs_are_read_without_jax(tmp_path):
    make(tmp_path / "run", SAC, stages=STAGES)
    code = "import sys; from jaxpend.runs.reader import listing; listing(sys.argv[1]); "
    code += "assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code, tmp_path], check=True)


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

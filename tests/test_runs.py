"""What a run folder keeps."""

import dataclasses
import json
import math
import os
import shutil
from pathlib import Path

import jax.numpy as jnp
import pytest
from conftest import limited_file_size, refused
from training_runs import rows_of

from jaxpend import JaxpendError, Policy, cli, load_policy
from jaxpend.config import SACRun, TrainRun
from jaxpend.config_files import to_mapping
from jaxpend.controllers.files import read_header
from jaxpend.runs.folder import RunFolder
from jaxpend.train import train

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


@dataclasses.dataclass(frozen=True)
class Inner:
    """A section."""

    speed: float = math.inf
    sizes: tuple[int, ...] = (1, 2)


@dataclasses.dataclass(frozen=True)
class Outer:
    """A configuration."""

    count: int = 3
    name: str = "a"
    fast: bool = False
    inner: Inner = dataclasses.field(default_factory=Inner)


def small_policy():
    """The smallest network that a file takes."""
    return Policy(((jnp.ones((6, 1)), jnp.zeros(1)),), torque_limit=jnp.asarray(3.0))


def test_a_run_folder_does_not_take_a_second_run(tmp_path):
    with RunFolder(tmp_path / "deep" / "run", Outer(), "command") as folder:
        folder.log("sac", score=0.5)
    with pytest.raises(JaxpendError, match="holds a run with count 3, not 9; choose") as error:
        RunFolder(folder.path, Outer(count=9), "command")
    assert "\n" not in str(error.value)
    assert json.loads((folder.path / "config.json").read_text())["count"] == 3


def test_the_same_run_is_taken_up_again_wherever_the_folder_is(tmp_path):
    config = TrainRun("acrobot", run="a", runs=str(tmp_path))
    with RunFolder(tmp_path / "a", config, "first") as folder:
        folder.log("sac", score=0.5)
    # Of a process killed while it wrote.
    (tmp_path / "a" / ".policy.npz.jaxpend-tmp-1234").touch()
    (tmp_path / "a").rename(tmp_path / "b")
    config = dataclasses.replace(config, run="b", on_divergence="rollback")
    with RunFolder(tmp_path / "b", config, "second") as folder:
        assert len((folder.path / "metrics.jsonl").read_text().splitlines()) == 1
        assert not list(folder.path.glob("*npz*"))
        assert not list(folder.path.glob(".*npz*"))
        assert json.loads((folder.path / "run.json").read_text())["command"] == "first"


def tree(folder):
    """Every file in a folder, with what is in it."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def user_folder(folder):
    """A folder with files of a user, under names that a run has too."""
    (folder / "checkpoints").mkdir(parents=True)
    for name in ("policy.npz", ".config.1", "metrics.jsonl", "run.json", "checkpoints/000001.npz"):
        (folder / name).write_text(f"mine: {name}")
    return folder


@pytest.mark.parametrize("seeds", [1, 2])
@pytest.mark.parametrize("name", ["policy.npz", ".config.1", "run.json", "seeds.json", "all"])
def test_a_folder_that_is_no_run_keeps_its_files(tmp_path, name, seeds):
    folder = tmp_path / "mine"
    if name == "all":
        user_folder(folder)
    else:
        folder.mkdir()
        (folder / name).write_text("mine")
    before = tree(tmp_path)
    with refused(f"{folder} is not empty and holds no run"):
        train(SACRun(runs=str(tmp_path), run="mine", seeds=seeds))
    assert tree(tmp_path) == before


def test_a_seed_whose_folder_is_no_run_stops_all_before_anything_is_made(tmp_path):
    user_folder(tmp_path / "mine" / "seed1")
    before = sorted(tmp_path.rglob("*"))
    with refused("seed1 is not empty and holds no run"):
        train(SACRun(runs=str(tmp_path), run="mine", seeds=2))
    assert sorted(tmp_path.rglob("*")) == before


def test_a_run_and_a_group_of_seeds_do_not_share_a_folder(tmp_path):
    RunFolder(tmp_path / "one", Outer(), "command").close()
    with refused("holds no runs of several seeds"):
        train(SACRun(runs=str(tmp_path), run="one", seeds=2))
    RunFolder(tmp_path / "many" / "seed0", Outer(), "command").close()
    with refused("many is not empty and holds no run"):
        train(SACRun(runs=str(tmp_path), run="many"))


def test_a_run_that_was_killed_while_it_began_can_begin_again(tmp_path):
    (tmp_path / ".lock").write_text("1234")
    (tmp_path / ".config.json.jaxpend-tmp-1234").write_text("{")
    RunFolder(tmp_path, Outer(), "command").close()
    (tmp_path / "config.json").unlink()
    with RunFolder(tmp_path, Outer(), "again") as folder:
        assert {p.name for p in folder.path.iterdir()} == {".lock", "config.json", "run.json"}


def test_only_its_own_temporary_files_are_removed_from_a_run(tmp_path):
    RunFolder(tmp_path, Outer(), "command").close()
    own = (".config.1", ".policy.npz.4711", "policy.npz.jaxpend-tmp-3", ".a.jaxpend-tmp-3.txt")
    for name in own:
        (tmp_path / name).write_text("mine")
    (tmp_path / ".policy.npz.jaxpend-tmp-3").touch()
    RunFolder(tmp_path, Outer(), "command").close()
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {*own, ".lock", "config.json", "run.json"}


def test_a_run_says_its_stages_and_its_plant_and_goes_on_with_no_other(tmp_path):
    about = {"plant": {"m1": 0.5, "l1": 0.2}, "stages": [{"name": "sac", "column": "env_steps"}]}
    with RunFolder(tmp_path, Outer(), "command", about) as folder:
        made_by = json.loads((folder.path / "run.json").read_text(), parse_constant=pytest.fail)
    assert {name: made_by[name] for name in about} == about
    RunFolder(tmp_path, Outer(), "command", about).close()
    other = about | {"plant": {"m1": 0.6, "l1": 0.2}}
    before = tree(tmp_path)
    with refused("holds a run with plant.m1 0.5, not 0.6; choose another name"):
        RunFolder(tmp_path, Outer(), "command", other)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("text", ["[]", "3", '{"score": "high"}', "{}", "[" * 100_000])
def test_a_result_of_wrong_types_is_one_sentence(tmp_path, text):
    RunFolder(tmp_path, Outer(), "command").close()
    (tmp_path / "result.json").write_text(text)
    with refused("result.json is damaged; choose another name or remove"):
        RunFolder(tmp_path, Outer(), "command")


def test_only_one_process_works_on_a_run(tmp_path):
    first = RunFolder(tmp_path, Outer(), "command")
    with pytest.raises(JaxpendError, match=rf"another process \({os.getpid()}\) is working on"):
        RunFolder(tmp_path, Outer(), "command")
    first.close()
    with RunFolder(tmp_path, Outer(), "command") as again:
        again.write_json("result.json", {"score": 1.0})
        # A finished run can be looked at meanwhile.
        assert RunFolder(tmp_path, Outer(), "command").result == {"score": 1.0}


def test_a_run_whose_folder_was_replaced_stops_and_leaves_the_new_one_alone(tmp_path):
    first = RunFolder(tmp_path / "run", Outer(), "command")
    first.log("sac", score=0.1)
    shutil.rmtree(first.path)
    with refused("was removed or replaced while a run was in it", start=str(first.path)):
        first.log("sac", score=0.2)
    with RunFolder(first.path, Outer(), "command") as second:
        second.log("sac", score=0.3)
        with refused("was removed or replaced"):
            first.log("sac", score=0.4)
        assert [row["score"] for row in rows_of(second.path, "sac")] == [0.3]
    first.close()


@pytest.mark.parametrize("name", ["config.json", "run.json", "result.json"])
def test_a_damaged_file_of_a_run_is_one_sentence(tmp_path, name):
    with RunFolder(tmp_path, Outer(), "command") as folder:
        folder.write_json("result.json", {"score": 1.0})
    (tmp_path / name).write_text('{"score"')
    with pytest.raises(JaxpendError, match=rf"{name} is damaged; choose another name or remove"):
        RunFolder(tmp_path, Outer(), "command")


def test_metrics_go_back_to_a_checkpoint_and_lose_a_row_cut_off(tmp_path):
    with RunFolder(tmp_path, Outer(), "command") as folder:
        folder.log("sac", env_steps=1)
        length = folder.metrics_bytes
        folder.log("sac", env_steps=2)
        with (tmp_path / "metrics.jsonl").open("a") as file:
            file.write('{"stage": "sa')
        folder.rewind(length, seconds=1000.0)
        folder.log("sac", env_steps=2)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["env_steps"] for row in rows] == [1, 2]
    assert 1000 <= rows[1]["seconds"] < 1060


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path, capsys):
    with RunFolder(tmp_path / "run", Outer(), "command"):
        pass
    before = {path: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    (tmp_path / "run" / ".lock").chmod(0o444)
    for folder in (tmp_path / "run", tmp_path):
        folder.chmod(0o555)
    user = os.geteuid()
    if user == 0:  # may write anywhere
        for parent in tmp_path.parents:
            if parent.name.startswith(("pytest-", "popen-")):  # of pytest and its workers
                parent.chmod(0o755)
        os.seteuid(65534)
    try:
        for name in ("run", "new"):
            with pytest.raises(SystemExit) as exit_, cli.one_sentence("prog"):
                RunFolder(tmp_path / name, Outer(), "command")
            assert exit_.value.code == 2
            where = tmp_path / "run" / ".lock" if name == "run" else tmp_path / "new"
            assert capsys.readouterr().err == f"prog: cannot use {where}: Permission denied\n"
    finally:
        os.seteuid(user)
        for folder in (tmp_path, tmp_path / "run"):
            folder.chmod(0o755)
    assert {path: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before


def test_a_full_disk_takes_no_part_of_a_row(tmp_path):
    with RunFolder(tmp_path, Outer(), "command") as folder:
        folder.log("sac", env_steps=1)
        before = (tmp_path / "metrics.jsonl").read_bytes()
        with limited_file_size(len(before) + 10), pytest.raises(OSError, match="File too large"):
            folder.log("sac", env_steps=2)
    assert (tmp_path / "metrics.jsonl").read_bytes() == before


def test_metrics_are_one_strict_json_row_an_evaluation(tmp_path):
    folder = RunFolder(tmp_path, Outer(), "command")
    folder.log("sac", env_steps=10, score=jnp.asarray(0.25), loss=jnp.asarray(jnp.nan))
    folder.log("snes", generation=1, best=math.inf)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    first, second = (json.loads(line, parse_constant=pytest.fail) for line in lines)
    assert first | {"seconds": 0} == {
        "stage": "sac", "seconds": 0, "env_steps": 10, "score": 0.25, "loss": None,
    }  # fmt: skip
    assert (second["stage"], second["generation"], second["best"]) == ("snes", 1, None)
    assert 0 <= first["seconds"] <= second["seconds"] < 60


def test_policies_say_what_made_them_and_replace_the_old_file_whole(tmp_path, monkeypatch):
    config = TrainRun("pendubot", seed=7)
    folder = RunFolder(tmp_path, config, "train --seed 7")
    path = folder.save("policy.npz", small_policy(), stage="sac", score=0.5)
    provenance = read_header(path)["provenance"]
    assert provenance["stage"] == "sac"
    assert provenance["config"] == to_mapping(config)
    assert provenance["command"] == "train --seed 7"
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="No space left"):
        folder.save("policy.npz", small_policy().replace(robot="acrobot"))
    assert path.read_bytes() == before
    assert {p.name for p in tmp_path.iterdir()} == {
        ".lock",
        "config.json",
        "policy.npz",
        "run.json",
    }
    assert load_policy(path).robot == "pendubot"

"""The whole job and its commands: what is left on disk, and how each kind of bad input ends."""

import dataclasses
import json
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused, shipped_network
from training_runs import OPTIONS, arrays_of, events_of, result_of, rows_of, training

from jaxpend import Policy, cli, designs, hosts, load_policy, save_policy
from jaxpend import stage as stage_module
from jaxpend.boards import v2
from jaxpend.config import (
    GradientConfig,
    GradientRun,
    Objective,
    SACRun,
    SNESConfig,
    SNESRun,
    TrainRun,
)
from jaxpend.controllers import Guarded, load_controller
from jaxpend.controllers.catalogue import build
from jaxpend.controllers.files import read_header
from jaxpend.controllers.policy import network_in
from jaxpend.score import imperfect, official
from jaxpend.train.interrupt import Stopped
from jaxpend.train.loop import stages_of, train

TASK = v2("pendubot").task
CRITERIA = {
    "swingup_time", "energy", "tau_cost", "tau_smoothness", "velocity_cost", "max_tau",
    "integ_tau",
}  # fmt: skip
FINE = "--snes.generations 3 --snes.population 4 --snes.chunk 2"


def policy_file(folder, robot="pendubot"):
    """A policy that does nothing useful, in a file."""
    path = folder / f"{robot}.npz"
    layers = ((jnp.full((6, 4), 0.3), jnp.zeros(4)), (jnp.ones((4, 1)), jnp.zeros(1)))
    save_policy(path, Policy(layers, torque_limit=jnp.asarray(3.0), robot=robot))
    return path


def run_command(monkeypatch, kind, *arguments):
    """A training command in this process. Raises SystemExit unless it exits with 0."""
    name = {SACRun: "sac", GradientRun: "gradient", SNESRun: "snes", TrainRun: "train"}[kind]
    monkeypatch.setattr("sys.argv", ["jaxpend", name, *map(str, arguments)])
    try:
        cli.main()
    except SystemExit as exit_:
        if exit_.code:
            raise


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    """The folder of a training run that was never interrupted, and what it said on its errors."""
    with training(tmp_path_factory.mktemp("training") / "whole") as process:
        out, err = process.communicate()
    assert (process.returncode, out) == (0, ""), err
    return Path(process.args[process.args.index("--runs") + 1]) / "run", err


def test_a_run_leaves_its_configuration_metrics_policies_and_result(whole_run):
    folder, said = whole_run
    names = {".lock", "config.json", "run.json", "metrics.jsonl", "result.json", "policy.npz"}
    names |= {f"{stage}_{kept}.npz" for stage in ("sac", "snes") for kept in ("best", "last")}
    assert {path.name for path in folder.iterdir()} == names
    config = json.loads((folder / "config.json").read_text(), parse_constant=pytest.fail)
    assert (config["seed"], config["robot"], config["sac"]["steps"]) == (3, "pendubot", 1024)
    assert [row["updates"] for row in rows_of(folder, "imitation")] == [*range(2000, 6001, 2000)]
    assert [row["env_steps"] for row in rows_of(folder, "sac")] == [*range(0, 1025, 64)]
    assert [row["generation"] for row in rows_of(folder, "snes")] == [*range(1, 7)]
    for stage in ("sac", "snes"):
        assert all(0 <= row.get("score", 0) < 1 for row in rows_of(folder, stage))
    # Progress from the first moment on, the results last.
    words = ["Imitation: compiling", "SAC 64/1,024", "SNES 2/6", "after SNES"]
    places = [said.replace("\n", "").index(word) for word in [*words, str(folder.name)]]
    assert places[:-1] == sorted(places[:-1])


def test_the_result_is_the_official_score_of_the_policy(whole_run):
    folder, _ = whole_run
    result = json.loads((folder / "result.json").read_text(), parse_constant=pytest.fail)
    policy = load_policy(folder / "policy.npz", robot="pendubot")
    again = official(policy, "pendubot")
    assert result["score"] == result["snes"]["score"] == again["score"]
    assert result["snes"]["criteria"] == again["criteria"]
    assert set(result["sac"]["criteria"]) >= CRITERIA
    assert result["snes"]["score"] >= result["sac"]["score"]
    provenance = read_header(folder / "policy.npz")["provenance"]
    assert (provenance["seed"], provenance["score"]) == (3, result["score"])
    # The policy is the one that SNES kept, made of the one that SAC kept, and guarded.
    for name in ("sac_best", "sac_last", "snes_best", "snes_last"):
        kept = load_policy(folder / f"{name}.npz")
        assert isinstance(kept, Guarded) == name.startswith("snes")
        assert len(network_in(kept).layers) == len(network_in(policy).layers) == 2
    kept = load_policy(folder / "snes_best.npz")
    jax.tree.map(np.testing.assert_array_equal, kept, policy)


def wait(process, until):
    """Wait for something that a process does before it ends."""
    while not until():
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.001)  # a checkpoint is written in some milliseconds


def test_a_run_killed_again_and_again_ends_as_one_that_never_was(whole_run):
    whole, _ = whole_run
    runs = whole.parents[1] / "killed"
    folder, often = runs / "run", ("--checkpoint.every", "0")

    def reached(stage, count, writing=False):
        def now():
            tmp = not writing or any((folder / "checkpoints").glob(".*jaxpend-tmp-*"))
            return tmp and len(rows_of(folder, stage)) >= count

        return now

    moments = [
        (reached("imitation", 1, writing=True), signal.SIGKILL),
        (reached("sac", 4), signal.SIGINT),
        (reached("sac", 9, writing=True), signal.SIGKILL),
        (reached("snes", 2), signal.SIGKILL),
    ]
    said = []
    for until, signum in moments:
        with training(runs, *often) as process:
            wait(process, until)
            before = rows_of(folder)
            process.send_signal(signum)
            out, err = process.communicate()
        said.append(err)
        assert (out, "Traceback" in err) == ("", False)
        assert not (folder / "result.json").exists()
        assert rows_of(folder)[: len(before)] == before
        if signum == signal.SIGKILL:
            assert process.returncode == -signum
            continue
        assert process.returncode == 128 + signum
        last = err.splitlines()[-1]
        assert last.startswith("jaxpend train: stopped in S")
        command = ["jaxpend", "train", *OPTIONS, "--runs", str(runs), *often]
        assert last.endswith(f"is in {folder}; to go on: {shlex.join(command)}")
    with training(runs, *often) as process:
        _, err = process.communicate()
    said.append(err)
    assert process.returncode == 0, err
    for text, stage in zip(said[2:], ["SAC", "SAC", "SNES"], strict=True):
        assert f"resuming {folder} in {stage} at " in text
    assert rows_of(folder) == rows_of(whole)
    assert result_of(folder) == result_of(whole)
    for name in ("sac_best.npz", "sac_last.npz", "snes_best.npz", "snes_last.npz", "policy.npz"):
        killed, never = arrays_of(folder / name), arrays_of(whole / name)
        assert killed.keys() == never.keys()
        for key in killed:
            np.testing.assert_array_equal(killed[key], never[key])
    assert {p.name for p in folder.iterdir()} == {p.name for p in whole.iterdir()}


def test_a_finished_run_is_not_trained_again(whole_run, monkeypatch, capsys):
    folder, _ = whole_run
    before = {path: path.read_bytes() for path in folder.iterdir()}
    run_command(monkeypatch, TrainRun, *OPTIONS, "--runs", folder.parent)
    score = json.loads((folder / "result.json").read_text())["score"]
    assert f"is finished: score {score:.4f}" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--sac.discount 0.9", "holds a run with sac.discount 0.99, not 0.9; choose another name"),
        ("--sac.env.reward.floor -2", "holds a run with sac.env.reward.floor -10.0, not -2.0;"),
        ("--seed 4", "holds a run with seed 3, not 4;"),
        ("--sac.actor-hidden 8 8", "holds a run with sac.actor_hidden [8], not [8, 8];"),
        ("version", "holds a run of jaxpend 0.0.9, this is"),
    ],
)
def test_a_run_of_another_kind_is_left_alone(
    whole_run, monkeypatch, capsys, tmp_path, options, words
):
    folder = tmp_path / "run"
    shutil.copytree(whole_run[0], folder)
    (folder / "result.json").unlink()
    if options == "version":
        (folder / "run.json").write_text('{"version": "0.0.9"}')
        options = ""
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(SystemExit) as exit_:
        run_command(monkeypatch, TrainRun, *OPTIONS, "--runs", tmp_path, *options.split())
    assert exit_.value.code == 2
    assert words in one_sentence(capsys.readouterr().err)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_snes_starts_from_a_policy_file(whole_run, monkeypatch, tmp_path):
    start = whole_run[0] / "sac_best.npz"
    options = ["--policy", start, "--runs", tmp_path, "--run", "fine", *FINE.split()]
    run_command(monkeypatch, SNESRun, *options)
    result = json.loads((tmp_path / "fine" / "result.json").read_text())
    assert result["start"]["score"] == official(load_policy(start), "pendubot")["score"]
    assert result["score"] >= result["start"]["score"]
    names = {path.name for path in (tmp_path / "fine").iterdir()}
    assert {"policy.npz", "snes_best.npz", "snes_last.npz"} <= names


def scalars(folder):
    """Steps of every scalar in the TensorBoard events of a run."""
    steps = {}
    for tag, step, _ in events_of(folder):
        steps.setdefault(tag, []).append(step)
    return steps


def test_the_gradient_starts_from_a_policy_file(monkeypatch, tmp_path):
    start, folder = tmp_path / "start.npz", tmp_path / "fine"
    save_policy(start, shipped_network(bias=0.05))
    options = ["--gradient.steps", "5", "--gradient.chunk", "3", "--gradient.learning-rate", "3e-5"]
    options += ["--policy", start, "--runs", tmp_path, "--run", "fine", "--tensorboard"]
    run_command(monkeypatch, GradientRun, *options)
    result = json.loads((folder / "result.json").read_text())
    assert result["score"] == result["gradient"]["score"] > result["start"]["score"]
    assert [row["step"] for row in rows_of(folder, "gradient")] == [0, 3, 5]
    assert scalars(folder)["gradient/score"] == [0, 3, 5]
    assert {"policy.npz", "gradient_best.npz"} <= {path.name for path in folder.iterdir()}


def test_the_gradient_has_a_place_between_sac_and_snes_where_it_has_steps():
    assert list(stages_of(TrainRun(), None, TASK)) == ["sac", "snes"]
    stages = stages_of(TrainRun(gradient=GradientConfig(steps=3)), None, TASK)
    assert list(stages) == ["sac", "gradient", "snes"]
    # What a checkpoint is read into is what a run has.
    stage, policy = stages["gradient"], load_policy("pendubot")
    stage = type(stage)(stage.config, policy, TASK)
    shapes = lambda tree: jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)  # noqa: E731
    assert shapes(stage.like()) == shapes(stage.start(0, policy))


def test_snes_fine_tunes_any_controller_and_goes_on_where_it_was(monkeypatch, tmp_path):
    monkeypatch.setattr(stage_module, "STANDING", 40)
    robust = Objective(0.5, "success", 24)
    snes = SNESConfig(
        generations=4, population=4, chunk=2, searched="gain", gain_sigma=0.3, objective=robust
    )
    run = SNESRun(controller="tvlqr", runs=str(tmp_path), run="whole", snes=snes)
    result = train(run)
    assert result["score"] >= result["start"]["score"] > 0.7
    last = load_controller(tmp_path / "whole" / "snes_last.npz", robot="pendubot")
    start = build("tvlqr", designs.competition("pendubot"), "pendubot")
    assert np.abs(last.gain / start.gain - 1).max() > 0.01
    np.testing.assert_array_equal(last.top.gain, start.top.gain)
    kept = load_controller(tmp_path / "whole" / "policy.npz")
    assert result["score"] == official(kept, "pendubot")["score"]
    # How often it stood before and stands now, in scenarios that nothing was chosen by.
    key = jax.random.key(stage_module.STANDING_SEED)
    shares = [imperfect(c, TASK, key, 40)[1].mean() for c in (start, kept)]
    np.testing.assert_allclose([*result["snes"]["standing"].values()], shares, atol=0.026)
    assert stage_module.STANDING_SEED != stage_module.VALIDATION_SEED
    # Stopped between two chunks, and taken up again: the same to the bit.
    run = dataclasses.replace(run, run="stopped")
    calls = iter([None, Stopped(signal.SIGINT)])

    def stop(agreed):
        if (now := next(calls, None)) is not None:
            raise now

    with monkeypatch.context() as patch:
        patch.setattr("jaxpend.train.loop.stop_if_asked", stop)
        with pytest.raises(Stopped):
            train(run)
    again = train(run)
    assert again["score"] == result["score"]
    assert again["snes"]["standing"] == result["snes"]["standing"]
    for name in ("policy.npz", "snes_last.npz"):
        found = arrays_of(tmp_path / "stopped" / name)
        expected = arrays_of(tmp_path / "whole" / name)
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            np.testing.assert_array_equal(found[key], value)


def test_a_host_that_is_gone_between_two_chunks_leaves_everything_on_disk(monkeypatch, tmp_path):
    snes = SNESConfig(generations=4, population=4, chunk=2, searched="gain", gain_sigma=0.3)
    run = SNESRun(controller="tvlqr", runs=str(tmp_path), run="run", snes=snes)
    calls = iter([None, hosts.Gone("another host is gone")])

    def agreed(agreed):
        if (now := next(calls, None)) is not None:
            raise now

    monkeypatch.setattr("jaxpend.train.loop.stop_if_asked", agreed)
    with refused("another host is gone; everything is in"):
        train(run)
    assert list((tmp_path / "run" / "checkpoints").glob("*.npz"))


def one_sentence(err):
    """The last line on standard error, after checking that it is the only one that complains."""
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if line.startswith("jaxpend ")]
    assert len(lines) == 1, err
    return lines[0]


@pytest.mark.parametrize(
    ("kind", "options", "words"),
    [
        (SNESRun, "--policy {}/nothing.npz", "there is no policy file"),
        (GradientRun, "--gradient.steps 0", "gradient.steps is 0"),
        (SNESRun, "--policy {}/acrobot.npz", "is a policy for the acrobot, not for the pendubot"),
        (SNESRun, "--policy {}/empty.npz", "is not a policy file, or it is empty or cut off"),
        (SNESRun, "--policy {}/cut.npz", "is not a policy file, or it is empty or cut off"),
        (SNESRun, "--snes.population 1", "population is 1"),
        (SNESRun, "--snes.searched gain", "has no parameter 'gain'; known: main.layers.0.0"),
        (TrainRun, "--snes.searched gain", "has no parameter 'gain'; known: layers.0.0"),
        (SNESRun, "--controller foo", "unknown controller 'foo'; known: policy, policy_network"),
        (SNESRun, "--controller open_loop", "OpenLoop declares no searched parameters"),
        (SACRun, "--sac.env.torque-limit 0", "torque_limit is 0.0; it must be positive"),
        (TrainRun, "--sac.env.torque-limit -3", "torque_limit is -3.0; it must be positive"),
        (TrainRun, "--robot cartpole", "robot is 'cartpole'; it must be acrobot or pendubot"),
        (TrainRun, "--config {}/nothing.yaml", "there is no configuration file"),
        (TrainRun, "--config {}/unknown.yaml", "sac.stepz is unknown; known: env, steps"),
        (TrainRun, "--runs {}/acrobot.npz", "cannot use"),
    ],
)
def test_bad_input_to_training_is_one_sentence(monkeypatch, capsys, tmp_path, kind, options, words):
    whole = policy_file(tmp_path, "acrobot").read_bytes()
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "unknown.yaml").write_text("sac: {stepz: 4}")
    before = set(tmp_path.rglob("*"))
    options = options.format(tmp_path).split()
    runs = [] if "--runs" in options else ["--runs", tmp_path / "runs"]
    with pytest.raises(SystemExit) as exit_:
        run_command(monkeypatch, kind, *runs, *options)
    assert exit_.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in one_sentence(err)
    assert set(tmp_path.rglob("*")) == before


def test_unknown_options_of_training_exit_with_2(monkeypatch, capsys, tmp_path):
    with pytest.raises(SystemExit) as exit_:
        run_command(monkeypatch, TrainRun, "--runs", tmp_path, "--sac.stepz", 4)
    assert exit_.value.code == 2
    out, err = capsys.readouterr()
    assert (out, list(tmp_path.iterdir())) == ("", [])
    assert "--sac.stepz" in err
    assert "Traceback" not in err


def test_score_command_prints_json_and_nothing_else(tmp_path):
    path = policy_file(tmp_path)
    line = [sys.executable, "-m", "jaxpend.score", "--robot", "pendubot"]
    line += ["--policy", path, "--json", "-"]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    result = json.loads(done.stdout, parse_constant=pytest.fail)
    assert set(result["criteria"]) >= CRITERIA
    expected = official(load_policy(path), "pendubot")
    assert {name: result[name] for name in expected} == expected
    assert (result["success"], result["score"]) == (False, 0.0)
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--policy {}/nothing.npz", "there is no policy file"),
        ("--policy {}/acrobot.npz", "is a policy for the acrobot, not for the pendubot"),
        ("--policy {}/empty.npz", "is not a policy file, or it is empty or cut off"),
        ("--robot cartpole --policy {}/acrobot.npz", "robot is 'cartpole'; it must be acrobot or"),
    ],
)
def test_bad_input_to_the_score_command_is_one_sentence(
    monkeypatch, capsys, tmp_path, options, words
):
    policy_file(tmp_path, "acrobot")
    (tmp_path / "empty.npz").write_bytes(b"")
    line = ["jaxpend", "score", *options.format(tmp_path).split(), "--json", "-"]
    monkeypatch.setattr("sys.argv", line)
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert exit_.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in one_sentence(err)

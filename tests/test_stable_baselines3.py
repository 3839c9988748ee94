"""The door for models of Stable-Baselines3: what a policy computes, and what a file may not do."""

import base64
import dataclasses
import io
import itertools
import os
import pickle
import re
import sys
import types
import zipfile
from typing import get_args

import jax
import numpy as np
import pytest
import sb3_files
from conftest import assert_close
from sb3_files import RELU, TANH, name, network, options, state_dict, text

from jaxpend import cli, load_policy
from jaxpend.boards import v2
from jaxpend.controllers.files import read_header
from jaxpend.designs import active_joint
from jaxpend.env import Env, EnvConfig
from jaxpend.fields import hints_of, split
from jaxpend.interop.stable_baselines3 import PRESETS, SEEN, Convention, declared, read_model
from jaxpend.interop.tensors import StateDict
from jaxpend.observation import Observation
from jaxpend.snes import SNESConfig, best_controller, evolve, init

STATES = np.random.default_rng(1).normal(size=(50, 4)) * [4, 4, 30, 30]
MEAN, VAR = np.array([0.1, -0.2, 0.3, 0.0]), np.array([0.5, 2.0, 0.01, 0.3])
ACTIVATIONS = {"relu": lambda v: np.maximum(v, 0), "tanh": np.tanh}
EVOLSAC = Convention(**PRESETS["evolsac"])


def layers_of(*widths, seed=0):
    """Layers (kernel, bias) in float32."""
    rng = np.random.default_rng(seed)
    return [
        (rng.normal(size=(a, b)).astype("f4"), rng.normal(size=b).astype("f4"))
        for a, b in itertools.pairwise(widths)
    ]


def wrapped(x, most):
    """The observation of the published policies, as their authors' code has it."""
    angles = (x[:2] % (2 * np.pi) - np.pi) / np.pi
    return np.append(angles, np.clip(x[2:], -most, most) / most)


def by_joint(x, most):
    """The other one of that code."""
    c1, c2, s1, s2 = *np.cos(x[:2]), *np.sin(x[:2])
    return np.append([c1, s1, c2, s2], np.clip(x[2:], -most, most) / most)


def mean_action(layers, activation, seen):
    """The network in plain numpy."""
    for kernel, bias in layers[:-1]:
        seen = ACTIVATIONS[activation](seen @ kernel + bias)
    return (seen @ layers[-1][0] + layers[-1][1])[0]


def torques(policy, joint):
    """Of the driven joint in STATES; that of the other must be 0."""
    found = jax.vmap(lambda x: policy(policy.reset(jax.random.key(0)), 0.0, x)[1])(STATES)
    assert not np.any(found[:, 1 - joint])
    return found[:, joint]


@pytest.mark.x64
@pytest.mark.parametrize("robot", ["acrobot", "pendubot"])
def test_sac_acts_as_its_authors_code(tmp_path, robot):
    layers = layers_of(4, 8, 8, 1)
    path = sb3_files.model(tmp_path / "m.zip", network(layers, "SAC"))
    found = read_model(path, robot, EVOLSAC)
    assert (found.algorithm, found.library) == ("SAC", "Stable-Baselines3 2.3.2")
    assert found.policy.robot == robot
    wanted = [3 * np.tanh(mean_action(layers, "relu", wrapped(x, 50))) for x in STATES]
    assert_close(torques(found.policy, active_joint(robot)), wanted)


@pytest.mark.x64
@pytest.mark.parametrize("bound", [1.0, 6.0])
def test_ppo_clips_at_the_ends_of_its_action_space(tmp_path, bound):
    layers = layers_of(4, 8, 1)
    space = options()["action_space"] | {"low": f"[{-bound}]", "high": f"[{bound}]"}
    path = sb3_files.model(tmp_path / "m.zip", network(layers, "PPO"), action_space=space)
    convention = Convention("state", 1.0, 6.0)
    found = read_model(path, "pendubot", convention)
    wanted = [6 * np.clip(mean_action(layers, "tanh", x) / bound, -1, 1) for x in STATES]
    assert 0 < np.mean(np.abs(wanted) < 6) < 1  # some are clipped
    assert_close(torques(found.policy, 0), wanted, times=1e3)  # weights are divided in float32


class RunningMeanStd:
    def __init__(self, mean, var):
        self.mean, self.var, self.count = mean, var, 1e-4


class VecNormalize:
    def __init__(self, **changes):
        self.obs_rms, self.ret_rms = RunningMeanStd(MEAN, VAR), RunningMeanStd(np.float64(0), 1.0)
        self.clip_obs, self.epsilon, self.norm_obs = 10.0, 1e-8, True
        self.returns, self.random = np.zeros(64), np.random.default_rng(0)
        vars(self).update(changes)


@pytest.fixture
def library(monkeypatch):
    """Modules under the names that the pickle of a VecNormalize has; gone when it is read."""
    names = {"stable_baselines3.common.vec_env.vec_normalize": VecNormalize,
             "stable_baselines3.common.running_mean_std": RunningMeanStd}  # fmt: skip

    def pickled(protocol=4, **changes):
        with monkeypatch.context() as patch:
            for module, kind in names.items():
                parents = [".".join(module.split(".")[:end]) for end in range(1, 5)]
                for parent in parents:
                    patch.setitem(sys.modules, parent, types.ModuleType(parent))
                patch.setattr(sys.modules[module], kind.__name__, kind, raising=False)
                patch.setattr(kind, "__module__", module)
            return pickle.dumps(VecNormalize(**changes), protocol)

    return pickled


@pytest.mark.x64
@pytest.mark.parametrize("kind", ["pickle 4", "pickle 5", "npz"])
def test_running_statistics_normalise_and_clip(tmp_path, library, kind):
    layers = layers_of(4, 8, 1)
    kwargs = {"activation_fn_pi": RELU, "activation_fn_vf": TANH}
    path = sb3_files.model(
        tmp_path / "m.zip", network(layers, "PPO"), policy_kwargs=kwargs,
        policy_class={"__module__": "double_pendulum.controller.AR_EAPO.ar_eapo"},
    )  # fmt: skip
    statistics = tmp_path / "vec_normalize_env.pkl"
    if kind == "npz":
        with statistics.open("wb") as file:
            np.savez(file, mean=MEAN, var=VAR, clip=2.0)
    else:
        statistics.write_bytes(library(int(kind[-1]), clip_obs=2.0))
    found = read_model(path, "acrobot", declared(path, "ar_eapo")).policy
    seen = [np.clip((wrapped(x, 20) - MEAN) / np.sqrt(VAR + 1e-8), -2, 2) for x in STATES]
    assert 0 < np.mean(np.abs(seen) == 2) < 1
    assert_close(torques(found, 1), [6 * np.tanh(mean_action(layers, "relu", s)) for s in seen])


@pytest.mark.x64
@pytest.mark.parametrize("algorithm", ["SAC", "PPO"])
def test_cosine_and_sine_by_joint(tmp_path, algorithm):
    """Normalised too; PPO with a single layer and actions in N m."""
    layers = layers_of(6, 8, 1) if algorithm == "SAC" else layers_of(6, 1)
    mean, var, most = np.arange(6) / 10, 0.1 + np.arange(6.0), 3.0
    space = options()["action_space"] | {"low": f"[{-most}]", "high": f"[{most}]"}
    path = sb3_files.model(tmp_path / "m.zip", network(layers, algorithm), action_space=space)
    np.savez(tmp_path / "s.npz", mean=mean, var=var, epsilon=1e-3)
    convention = Convention("sincos_by_joint", 20.0, most, str(tmp_path / "s.npz"))
    seen = [(by_joint(x, 20) - mean) / np.sqrt(var + 1e-3) for x in STATES]
    means = np.array([mean_action(layers, "relu", s) for s in seen])
    wanted = most * np.tanh(means) if algorithm == "SAC" else np.clip(means, -most, most)
    assert_close(torques(read_model(path, "pendubot", convention).policy, 0), wanted, times=1e3)


def test_a_policy_that_was_read_can_be_trained_further(tmp_path):
    """Also where it sees normalised observations and its actions are clipped: not only a number."""
    path = sb3_files.model(tmp_path / "m.zip", network(layers_of(4, 3, 1), "PPO"))
    np.savez(tmp_path / "s.npz", mean=MEAN, var=VAR)
    convention = Convention("wrapped", 20.0, 3.0, str(tmp_path / "s.npz"))
    policy = read_model(path, "pendubot", convention).policy
    task = dataclasses.replace(v2("pendubot").task, duration=0.2)
    config = SNESConfig(population=4, action_noise=0.3)
    state, metrics = evolve(config, policy, init(config, policy, jax.random.key(0)), 2, task)
    best = best_controller(config, policy, state)
    assert best.observation == policy.observation
    assert np.isfinite(metrics["max_fitness"]).all()
    assert not np.array_equal(best.layers[0][0], policy.layers[0][0])


def test_what_our_own_environments_show_is_a_preset(tmp_path):
    env, layers = Env(EnvConfig(), v2("acrobot").task), layers_of(6, 8, 1)
    path = sb3_files.model(tmp_path / "m.zip", network(layers, "SAC"))
    policy = read_model(path, "acrobot", declared(path, "gymnasium")).policy
    assert policy.observation == env.config.observation
    assert policy.torque_limit == env.config.torque_limit
    # Options go before a preset.
    assert declared(path, "gymnasium", torque_limit=6.0).torque_limit == 6.0


@pytest.mark.parametrize("kind", ["sincos", "angles"])
def test_memory_is_that_of_our_own_environments(here, monkeypatch, capsys, kind):
    shown = {"kind": kind, "max_velocity": 5.0, "history": 2, "max_turn": 0.2}
    env = Env(EnvConfig(dt=0.02, observation=Observation(**shown)), v2("pendubot").task)
    start = env.reset(jax.random.key(0))
    layers = layers_of(len(start.obs), 8, 1)
    sb3_files.model(here / "m.zip", network(layers, "SAC"))
    line = f"m.zip --robot pendubot --preset gymnasium --observation {kind} --max-velocity 5"
    line += " --history 2 --control-dt 0.02 --max-turn 0.2 --out p.npz"
    assert run(monkeypatch, capsys, "import", *line.split())[0] == 0
    policy = load_policy(here / "p.npz")
    assert (policy.observation, policy.control_dt) == (env.config.observation, env.config.dt)
    torque = policy(policy.reset(jax.random.key(0)), 0.0, start.x)[1][0]
    assert_close(torque, 3 * np.tanh(mean_action(layers, "relu", np.asarray(start.obs))), times=1e3)


def test_the_options_are_those_of_the_convention():
    """They are written twice, since the help of a command does not wait for jax."""
    options, fields = hints_of(cli.function_of("import")), hints_of(Convention)
    assert get_args(split(options["preset"])[0]) == tuple(PRESETS)
    for key in fields.keys() - {"statistics"}:
        assert split(options[key])[:2] == split(fields[key])[:2], key
    assert get_args(fields["observation"]) == tuple(SEEN)


def test_tensors_in_any_layout_are_read():
    rng = np.random.default_rng(0)
    weight = rng.normal(size=(3, 2))
    for dtype in ("f4", "f8", "f2"):
        for order in (b"little", b"big"):
            there = {"a": weight.astype(dtype), "b": weight[0].astype(dtype)}
            found = StateDict(state_dict(there, order=order))
            assert list(found) == ["a", "b"]
            np.testing.assert_array_equal(found.read("a"), there["a"].astype("f4"))
            np.testing.assert_array_equal(found.read("b"), there["b"].astype("f4"))
    turned = state_dict({"a": weight}, shape=(2, 3), strides=(1, 2))
    np.testing.assert_array_equal(StateDict(turned).read("a"), weight.astype("f4").T)
    part = state_dict({"a": weight}, shape=(2,), strides=(2,), offset=1)
    np.testing.assert_array_equal(StateDict(part).read("a"), weight.astype("f4")[:2, 1])


def run(monkeypatch, capsys, *words):
    """Exit code and standard error of ``jaxpend``."""
    monkeypatch.setattr("sys.argv", ["jaxpend", *map(str, words)])
    monkeypatch.setattr("jaxpend.terminal.console._file", None)
    with pytest.raises(SystemExit) as end:
        cli.main()
    out, err = capsys.readouterr()
    assert out == ""
    return end.value.code, err


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory with a model of SAC in it."""
    monkeypatch.chdir(tmp_path)
    sb3_files.model(tmp_path / "model.zip", network(layers_of(4, 8, 8, 1), "SAC"))
    return tmp_path


LINE = ["import", "model.zip", "--robot", "pendubot", "--preset", "evolsac", "--out", "policy.npz"]


def test_the_command_writes_a_file_that_others_take(here, monkeypatch, capsys):
    code, err = run(monkeypatch, capsys, *LINE)
    assert code == 0
    assert "jaxpend score --robot pendubot --policy policy.npz" in " ".join(err.split())
    policy, wanted = load_policy("policy.npz"), read_model("model.zip", "pendubot", EVOLSAC).policy
    jax.tree.map(np.testing.assert_array_equal, policy, wanted)
    assert jax.tree.structure(policy) == jax.tree.structure(wanted)
    said = read_header("policy.npz")["provenance"]
    assert said == {"command": f"jaxpend {' '.join(LINE)}", "algorithm": "SAC",
                    "library": "Stable-Baselines3 2.3.2"}  # fmt: skip
    assert run(monkeypatch, capsys, *LINE)[0] == 0  # its own file it writes again


@pytest.mark.parametrize("line", [
    "score --policy model.zip", "robustness --policy model.zip", "leaderboard --policy model.zip",
    "report model.zip", "snes --policy model.zip", "gradient --policy model.zip",
])  # fmt: skip
def test_a_model_in_place_of_a_policy_is_answered_with_the_command(here, monkeypatch, capsys, line):
    code, err = run(monkeypatch, capsys, *line.split())
    words = "model.zip is a model of Stable-Baselines3; make a policy file of it with jaxpend "
    words += "import model.zip --robot ROBOT --out policy.npz\n"
    assert (code, err) == (2, f"jaxpend {line.split()[0]}: {words}")
    assert [path.name for path in here.iterdir()] == ["model.zip"]


def with_tensors(**changes):
    """A model with other tensors, which ``network`` names with dots."""
    there = network(layers_of(4, 8, 8, 1), "SAC")
    changes = {key.replace("__", "."): value for key, value in changes.items()}
    return {"tensors": {k: v for k, v in (there | changes).items() if v is not None}}


def with_pickle(instructions):
    """A model with other instructions in the pickle of its tensors."""
    return {"tensors": {}, "policy": state_dict({}, pickled=instructions)}


def with_odd(**odd):
    """A model whose tensors are said to be of another shape."""
    return {"tensors": {}, "policy": state_dict(network(layers_of(4, 8, 8, 1), "SAC"), **odd)}


def bomb():
    """A small file that says that it is huge."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(2**21))
    return file.getvalue()


# A tuple of two tuples of two tuples ...: it would take for ever to write, compare or hash it.
ENDLESS = b")" + b"q\x07h\x07\x86" * 60


DAMAGED = "model.zip is not a model of Stable-Baselines3, or it is empty, cut off or damaged\n"
PPO = network(layers_of(4, 8, 1), "PPO")
LAYERS = "its layers are actor.mu.0, ...; those of SAC (actor.latent_pi, actor.mu) or PPO ("
HUGE = options()["action_space"] | {"low": "[-inf]", "high": "[inf]"}
BAD = {
    "another algorithm": ({"tensors": {"actor.mu.0.weight": np.ones((1, 4), "f4")}}, LAYERS),
    "no layers": ({"tensors": {}}, "its layers are none, ..."),
    "recurrent": ({"tensors": PPO | {"lstm_actor.bias": np.ones(3, "f4")}},
                  "it has a layer lstm_actor.bias, which plain PPO does not"),
    "extractor": (with_tensors(actor__features_extractor__cnn=np.ones(3, "f4")),
                  "it has a layer actor.features_extractor.cnn, which plain SAC does not"),
    "extractor without weights": (
        {"tensors": network(layers_of(4, 8, 1), "SAC"), "policy_kwargs": {
            "features_extractor_class": "<class 'mine.Extractor'>"}},
        "it has a features extractor of its own; a plain network is read"),
    "layer norm": (with_tensors(actor__latent_pi__1__weight=np.ones(8, "f4")),
                   "the layers of actor.latent_pi are not linear ones and activations by turns"),
    "no bias": (with_tensors(actor__mu__bias=None), DAMAGED),
    "misfit": (with_tensors(actor__latent_pi__2__weight=np.ones((8, 9), "f4")),
               "actor.latent_pi.2 is not a linear layer that fits the one before it"),
    "vector": (with_tensors(actor__mu__weight=np.ones(8, "f4")), "actor.mu is not a linear layer"),
    "integers": (with_tensors(actor__mu__bias=np.ones(1, "i8")), "actor.mu.bias is of LongStorage"),
    "not finite": (with_tensors(actor__mu__bias=np.array([np.nan], "f4")), "actor.mu holds values"),
    "observation": ({"tensors": network(layers_of(6, 8, 1), "SAC")},
                    "its network sees 6 numbers, 'wrapped' is 4; declare the observation"),
    "dictionary": ({"tensors": PPO, "observation_space": {":type:": "<class 'x.dict.Dict'>"}},
                   "its observation is not one vector of numbers, a Box"),
    "actions": ({"tensors": network(layers_of(4, 8, 2), "SAC")}, "it has 2 actions; one is read"),
    "activation": ({"tensors": network(layers_of(4, 8, 1), "SAC"), "policy_kwargs": {
        "activation_fn": "<class 'torch.nn.modules.activation.ELU'>"}}, "its activation is ELU;"),
    "own class": ({"tensors": PPO, "policy_class": {"__module__": "mine"}},
                  "its policy is of a class of mine; declare whether that squashes actions by"),
    "no bounds": ({"tensors": PPO, "action_space": HUGE}, "its actions are from -inf to inf; they"),
    "one-sided": ({"tensors": network(layers_of(4, 8, 1), "SAC"), "action_space": HUGE | {
        "low": "[0.]", "high": "[6.]"}}, "its actions are from 0 to 6; they must be symmetric"),
    "tiny": ({"tensors": PPO, "action_space": HUGE | {"low": "[-1e-300]", "high": "[1e-300]"}},
             "its actions are from -1e-300 to 1e-300; they must be symmetric, and the largest"),
    "no space": ({"tensors": PPO, "action_space": {}}, DAMAGED),
    "not json": ({"tensors": PPO, "data": "{"}, DAMAGED),
    "deep json": ({"tensors": PPO, "data": "[" * 100_000}, DAMAGED),
    "no mapping": ({"tensors": PPO, "data": "[]"}, DAMAGED),
    "no torch file": ({"tensors": {}, "policy": b"torch"}, DAMAGED),
    "pickle of old": ({"tensors": {}, "policy": pickle.dumps({}, 2)}, DAMAGED),
    "bomb": ({"tensors": {}, "policy": bomb()},
             "archive/data.pkl in it has 2,097,152 bytes; at most 1,048,576 are read"),
    "no end": (with_pickle(b"}("), DAMAGED),
    "nothing": (with_pickle(b"0"), DAMAGED),
    "list": (with_pickle(b"]"), "its layers are none"),
    "number": (with_pickle(b"K\x01"), DAMAGED),
    "endless key": (with_pickle(b"}" + ENDLESS + b"K\x01s"), DAMAGED),
    "endless name": (with_pickle(ENDLESS + text("x") + b"\x93"), DAMAGED),
    "endless call": (with_pickle(ENDLESS + b")R"), DAMAGED),
    "endless axes": (with_odd(shape=(1,) * 1000, strides=(1,) * 1000), DAMAGED),
    "too far": (with_odd(offset=1), DAMAGED),
    "out of nothing": (with_odd(shape=(2**20, 2**20), strides=(0, 0)), DAMAGED),
    "backwards": (with_odd(shape=(2, 2), strides=(-1, -1)), DAMAGED),
    "wrong count": (with_odd(count=1), DAMAGED),
    "strides": (with_odd(strides=(1,)), DAMAGED),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_plain_actor_is_one_sentence(here, monkeypatch, capsys, case):
    changes, words = BAD[case]
    sb3_files.model(here / "model.zip", **changes)
    code, err = run(monkeypatch, capsys, *LINE)
    start = "" if words is DAMAGED else "model.zip: "
    assert err.startswith(f"jaxpend import: {start}{words}")
    assert (code, err.count("\n")) == (2, 1)
    assert [path.name for path in here.iterdir()] == ["model.zip"]


@pytest.mark.parametrize(("line", "words"), [
    ("nothing.zip --robot acrobot --preset evolsac --out p.npz", "there is no model nothing.zip"),
    (". --robot acrobot --preset evolsac --out p.npz", ". is not a model of Stable-Baselines3"),
    ("empty --robot acrobot --preset evolsac --out p.npz", "empty is not a model of Stable-"),
    ("cut.zip --robot acrobot --preset evolsac --out p.npz", "cut.zip is not a model of Stable-"),
    ("flip.zip --robot acrobot --preset evolsac --out p.npz", "flip.zip is not a model of Stable-"),
    ("s.npz --robot acrobot --preset evolsac --out p.npz", "s.npz: it is a zip, but no model that"),
    ("model.zip --robot acrobot --out p.npz", "declare max_velocity, observation, torque_limit, "
     "which model.zip does not say, or a preset: evolsac, ar_eapo, gymnasium"),
    ("model.zip --robot acrobot --observation state --max-velocity 1 --out p.npz",
     "declare torque_limit, which model.zip does not say"),
    ("model.zip --robot cartpole --preset evolsac --out p.npz", "--robot is 'cartpole'; it must"),
    ("model.zip --robot acrobot --preset sac --out p.npz", "--preset is 'sac'; it must be evolsac"),
    ("model.zip --robot acrobot --preset ar_eapo --out p.npz", "there are no running statistics "
     "vec_normalize_env.pkl"),
    ("model.zip --robot acrobot --preset evolsac --squash clip --out p.npz", "model.zip: it is of "
     "SAC, which squashes by tanh, not clip"),
    ("model.zip --robot acrobot --preset evolsac --torque-limit 0 --out p.npz", "--torque-limit is"
     " 0.0; it must be positive"),
    ("model.zip --robot acrobot --preset evolsac --torque-limit 1e39 --out p.npz", "--torque-limit"
     " is 1e+39; it must be at most 1,000,000,000"),
    ("model.zip --robot acrobot --preset evolsac --max-velocity 1e-46 --out p.npz", "--max-velocity"
     " is 1e-46; it must be at least 1e-09"),
    ("model.zip --robot acrobot --preset evolsac --history 2 --out p.npz", "history is 2; declare "
     "control_dt, its period, too"),
    ("model.zip --robot acrobot --preset evolsac --history -1 --out p.npz", "--history is -1; it "),
    ("model.zip --robot acrobot --preset evolsac --history 2 --control-dt 0 --out p.npz",
     "--control-dt is 0.0; it must be positive"),
    *((f"model.zip --robot acrobot --preset evolsac --history 2 --control-dt {dt} --out p.npz",
       "--control-dt is") for dt in ("3.7", "1e9", "nan")),
    ("model.zip --robot acrobot --preset evolsac --history 2 --control-dt 0.02 --out p.npz",
     "model.zip: its network sees 4 numbers, 'wrapped' with history 2 is 14; declare"),
    ("model.zip --robot acrobot --preset evolsac --history 2 --control-dt 0.02 --statistics s.npz "
     "--out p.npz", "history is 2; with running statistics it must be 0"),
    ("model.zip --robot acrobot --preset evolsac --observation sincos_by_joint --history 2 "
     "--control-dt 0.02 --out p.npz", "history is 2; with observation 'sincos_by_joint' it must"),
    ("model.zip --robot acrobot --preset evolsac --observation angles --out p.npz",
     "model.zip: history is 0; angles are seen without velocities"),
    ("model.zip --robot acrobot --preset evolsac", "--out is missing; see jaxpend import --help"),
    ("--robot acrobot --preset evolsac --out p.npz", "MODEL is missing"),
    ("model.zip --robot acrobot --preset evolsac --out -", "--out is -; a policy file cannot"),
    ("model.zip --robot acrobot --preset evolsac --out .", "cannot write .: it is a folder"),
    ("model.zip --robot acrobot --preset evolsac --out empty", "cannot write empty: it is there "
     "and is no policy file; choose another name"),
    ("model.zip --robot acrobot --preset evolsac --out model.zip", "cannot write model.zip: it is"),
    *((f"model.zip --robot acrobot --preset evolsac --out p.npz --statistics {file}", words)
      for file, words in (
        ("empty", "empty holds no running statistics of observations, or it is cut off or damaged"),
        ("model.zip", "model.zip holds no running statistics of observations"),
        ("s.npz", "mean is (0.0, 0.0, 0.0); it must be 4 values, as many as 'wrapped' sees"),
        ("negative.npz", "negative.npz holds no running statistics"),
        ("far.npz", "far.npz holds no running statistics"),
        ("large.npz", "large.npz: it has 2,400,"),
        ("off.pkl", "off.pkl: it does not normalise observations; leave it out"))),
])  # fmt: skip
def test_what_is_wrong_on_the_line_is_one_sentence(here, library, monkeypatch, capsys, line, words):
    whole = (here / "model.zip").read_bytes()
    (here / "empty").touch()
    (here / "cut.zip").write_bytes(whole[: len(whole) // 2])
    place = whole.index(b"archive/data/0") + 100  # in the numbers of the first layer
    (here / "flip.zip").write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    np.savez(here / "s.npz", mean=np.zeros(3), var=np.ones(3))
    np.savez(here / "far.npz", mean=np.full(4, 1e300), var=np.ones(4))
    np.savez(here / "negative.npz", mean=np.zeros(4), var=-np.ones(4))
    np.savez(here / "large.npz", mean=np.zeros(300_000), var=np.ones(4))
    (here / "off.pkl").write_bytes(library(norm_obs=False))
    before = {path: path.read_bytes() for path in here.iterdir()}
    code, err = run(monkeypatch, capsys, "import", *line.split())
    assert err.startswith(f"jaxpend import: {words}") or f"model.zip: {words}" in err
    assert (code, err.count("\n")) == (2, 1)
    assert {path: path.read_bytes() for path in here.iterdir()} == before


class Payload:
    """What a pickle does that its author wants to be run."""

    def __init__(self, made):
        self.made = made

    def __reduce__(self):
        return os.mkdir, (str(self.made),)


def test_the_payload_works(tmp_path):
    """Where a pickle is unpickled, it would do its work."""
    pickle.loads(pickle.dumps(Payload(tmp_path / "made")))
    assert (tmp_path / "made").exists()


WHERE = ["value", "layer", "before", "attribute", "options", "statistics", "attribute of those"]


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize("where", WHERE)
def test_no_payload_is_run(here, library, monkeypatch, capsys, where, protocol):
    made = here / "made"
    payload = pickle.dumps(Payload(made), protocol)[
        2 + 9 * (protocol == 4) : -1
    ]  # no start, no end
    statistics, words = here / "vec_normalize_env.pkl", "it names posix.mkdir, which has no place"
    statistics.write_bytes(library())
    ordered = name("collections", "OrderedDict") + b")R"
    start, changes = "model.zip", {"policy_class": {"__module__": "mine"}, "tensors": PPO}
    if where == "value":
        changes["policy"] = state_dict({}, pickled=payload)
    elif where == "layer":
        whole = ordered + b"(" + text("action_net.weight") + payload + b"u"
        changes["policy"] = state_dict({}, pickled=whole)
    elif where == "before":
        changes["policy"] = state_dict({}, pickled=payload + b"0" + ordered)
    elif where == "attribute":
        state = b"}" + text("_metadata") + payload + b"sb"
        changes["policy"] = state_dict({}, pickled=ordered + state)
    elif where == "options":  # which are read as text, so that there is nothing to refuse
        coded = base64.b64encode(pickle.dumps(Payload(made), protocol)).decode()
        kinds = {key: value | {":serialized:": coded} for key, value in options().items()}
        changes |= kinds | {"learning_rate": {":type:": "float", ":serialized:": coded}}
        words = ""
    else:
        start = "vec_normalize_env.pkl"
        inner = {"obs_rms": Payload(made)} if where == "statistics" else {"odd": Payload(made)}
        statistics.write_bytes(library(max(protocol, 4), **inner))
    sb3_files.model(here / "model.zip", **changes)
    line = [*LINE[:4], "--preset", "ar_eapo", "--out", "policy.npz"]
    code, err = run(monkeypatch, capsys, *line)
    assert not made.exists()
    if words:
        assert (code, err.count("\n")) == (2, 1)
        assert err.startswith(f"jaxpend import: {start}: {words}")
    assert (here / "policy.npz").exists() == (not words) == (code == 0)


def test_nothing_of_a_file_is_imported(here, library, monkeypatch, capsys):
    """Also names that are expected are only compared, not looked up."""
    (here / "vec_normalize_env.pkl").write_bytes(library())
    sb3_files.model(here / "model.zip", PPO, policy_class={"__module__": "mine"})
    before = set(sys.modules)
    monkeypatch.setattr(pickle, "Unpickler", None)
    monkeypatch.setattr(pickle, "loads", None)
    line = [*LINE[:4], "--preset", "ar_eapo", "--out", "policy.npz"]
    assert run(monkeypatch, capsys, *line)[0] == 0
    assert not {n for n in set(sys.modules) - before if re.match("torch|stable_base|gym", n)}

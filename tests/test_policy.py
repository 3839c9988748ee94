"""Policies: what the network computes, and what a policy file does and does not hold."""

import dataclasses
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, both_robots, refused, rewrite

from jaxpend import JaxpendError, Policy, load_policy, save_policy
from jaxpend.boards import v2
from jaxpend.controller import robot_of
from jaxpend.controllers.files import read_header
from jaxpend.designs import active_joint
from jaxpend.env import Env, EnvConfig
from jaxpend.observation import Observation
from jaxpend.robots import SHIPPED
from jaxpend.rollout import rollout

KEY = jax.random.key(0)
STATE = np.array([3.5, -7.0, 2.0, -30.0], "f4")
NUMPY_ACTIVATIONS = {
    "relu": lambda v: np.maximum(v, 0),
    "tanh": np.tanh,
    "silu": lambda v: v / (1 + np.exp(-v)),
}


def random_policy(robot="pendubot", kind="sincos", activation="relu", sizes=(16, 8), history=0):
    """A small network with weights from a fixed seed."""
    rng = np.random.default_rng(0)
    observation = Observation(kind, history=history)
    widths = [observation.size, *sizes, 1]
    layers = tuple(
        (jnp.asarray(rng.normal(size=(a, b)) / 3, "f4"), jnp.asarray(rng.normal(size=b) / 3, "f4"))
        for a, b in itertools.pairwise(widths)
    )
    limit = jnp.asarray(3.0, jnp.float32)
    return Policy(layers, limit, robot=robot, observation=observation, activation=activation)


def numpy_torque(policy, observation):
    """The same network in plain numpy, float64."""
    act = {
        "relu": lambda v: np.maximum(v, 0),
        "tanh": np.tanh,
        "silu": lambda v: v / (1 + np.exp(-v)),
    }
    h = np.asarray(observation, float)
    *hidden, (kernel, bias) = policy.layers
    for w, b in hidden:
        h = act[policy.activation](h @ w + b)
    return 3.0 * np.tanh((h @ kernel + bias)[0])


@both_robots
@pytest.mark.parametrize("kind", ["wrapped", "sincos"])
@pytest.mark.parametrize("activation", NUMPY_ACTIVATIONS)
def test_torque_is_that_of_the_network_on_the_driven_joint(robot, kind, activation):
    policy = random_policy(robot, kind, activation)
    carry, torque = policy(policy.reset(KEY), 0.0, jnp.asarray(STATE))
    assert carry == (None, None)
    observation = policy.observation(STATE)
    assert observation.shape == (policy.observation.size,)
    assert_close(torque[active_joint(robot)], numpy_torque(policy, observation))
    assert torque[1 - active_joint(robot)] == 0


def test_observations_worked_out_by_hand():
    q1, q2, w1, w2 = STATE.astype(float)
    sincos = [np.cos(q1), np.cos(q2), np.sin(q1), np.sin(q2), w1 / 20, w2 / 20]
    assert_close(Observation("sincos")(STATE), sincos)
    # Angles lie on [0, 2 pi) before they are scaled, and velocities are clipped.
    wrapped = [(q1 - np.pi) / np.pi, (q2 + 4 * np.pi - np.pi) / np.pi, 0.1, -1.0]
    assert_close(Observation("wrapped")(STATE), wrapped)
    assert_close(Observation("sincos_clipped")(STATE), [*sincos[:4], 0.1, -1.0])
    assert_close(Observation("state")(STATE), [q1, q2, w1 / 20, w2 / 20])
    turned = STATE + np.array([2 * np.pi, -4 * np.pi, 0, 0], "f4")
    assert_close(Observation("sincos")(turned), Observation("sincos")(STATE), times=5)


def test_observations_are_normalised_and_then_clipped():
    wrapped, mean = Observation("wrapped")(STATE), (0.1, 0.2, -0.3, 0.4)
    std = (0.5, 1.0, 0.01, 2.0)
    view = Observation("wrapped", mean=mean, std=std)
    wanted = [(w - m) / s for w, m, s in zip(wrapped, mean, std, strict=True)]
    assert wanted[2] > 30
    assert_close(view(STATE), wanted)
    clipped = dataclasses.replace(view, clip=0.6)
    assert_close(clipped(STATE), np.clip(wanted, -0.6, 0.6))
    assert_close(Observation("wrapped", mean=mean)(STATE), wrapped - np.array(mean, "f4"))
    # What is seen of the past is normalised too, its actions are not.
    past = jnp.asarray([[*STATE, 0.7]])
    assert_close(dataclasses.replace(clipped, history=1)(STATE, past),
                 [*clipped(STATE), *clipped(STATE), 0.7])  # fmt: skip


def test_what_looks_alike_left_and_right():
    assert Observation("wrapped", std=(1.0, 2.0, 3.0, 4.0)).symmetric
    assert Observation("sincos", mean=(0.5, 0.9, 0.0, 0.0, 0.0, 0.0)).symmetric
    assert not Observation("sincos", mean=(0.5, 0.9, 0.0, 0.0, 0.0, 0.1)).symmetric
    assert not Observation("state", mean=(1.0, 0.0, 0.0, 0.0)).symmetric


def test_an_action_may_be_clipped_in_place_of_the_tanh():
    policy = random_policy().replace(squash="clip")
    pre = float(policy.pre_action(policy.observation(STATE)))
    assert pre
    for scale in (0.9 / abs(pre), 1.1 / abs(pre)):
        *hidden, (kernel, bias) = policy.layers
        scaled = policy.replace(layers=(*hidden, (kernel * scale, bias * scale)))
        torque = scaled((None, None), 0.0, STATE)[1]
        assert_close(torque[0], 3 * np.clip(pre * scale, -1, 1))


def test_action_noise_is_drawn_before_the_squashing_and_anew_each_step():
    policy = random_policy().replace(action_noise=jnp.asarray(0.1, jnp.float32))
    quiet = policy.replace(action_noise=jnp.zeros(()))
    step = jax.jit(lambda policy, carry: policy(carry, 0.0, STATE))
    carry, torques = policy.reset(KEY), []
    for _ in range(200):
        carry, torque = step(policy, carry)
        torques.append(torque[0])
    noise = np.arctanh(np.array(torques) / 3.0) - float(
        policy.pre_action(policy.observation(STATE))
    )
    np.testing.assert_allclose(noise.std(), 0.1, rtol=0.2)
    np.testing.assert_allclose(noise.mean(), 0.0, atol=0.03)
    assert len(np.unique(noise)) > 190
    greedy = random_policy()((None, None), 0.0, STATE)[1]
    assert_close(step(quiet, quiet.reset(KEY))[1], greedy)


@pytest.mark.parametrize("calls", [1, 5, 10])  # a period of 10 ms
def test_memory_goes_back_whole_periods_however_often_it_is_asked(calls):
    policy, rng = random_policy(history=3), np.random.default_rng(1)
    memory, dt = policy.reset(KEY)[1], 0.01 / calls
    states = rng.normal(size=(6 * calls, 4)).astype("f4")
    actions = rng.uniform(-1, 1, 6 * calls).astype("f4")
    past = jax.jit(lambda memory, t, x: memory.past(3, 0.01, t, x))
    for k, (x, action) in enumerate(zip(states, actions, strict=True)):
        seen = past(memory, np.float32(k * dt), x)
        ago = k - calls * np.arange(1, 4)
        # Before the first call: the first state, and no action.
        np.testing.assert_array_equal(seen[:, :4], states[np.maximum(ago, 0)])
        padded = np.append(np.zeros(3 * calls), actions)
        expected = [padded[3 * calls + a : 4 * calls + a].mean() for a in ago]
        assert_close(seen[:, 4], expected, times=5)
        memory = memory.after(np.float32(k * dt), x, action)


@both_robots
def test_a_rollout_at_the_period_of_training_is_an_episode_of_the_environment(robot):
    policy = random_policy(robot, activation="tanh", history=2)
    env = Env(EnvConfig(observation=policy.observation), v2(robot).task)
    run = jax.jit(lambda: rollout(env.plant, policy, KEY, dt=0.01, duration=0.4))()
    state, step = env.reset(KEY), jax.jit(env.step)
    for k in range(40):
        wanted = numpy_torque(policy, state.obs)
        assert_close(run.u[k][active_joint(robot)], wanted, times=20)
        state = step(state, jnp.asarray(wanted / 3.0, jnp.float32))
    assert_close(run.x[40], state.x, times=20)
    forgetful = policy.replace(layers=((policy.layers[0][0].at[6:].set(0), policy.layers[0][1]),
                                       *policy.layers[1:]))  # fmt: skip
    other = rollout(env.plant, forgetful, KEY, dt=0.01, duration=0.4)
    assert np.abs(other.u - run.u).max() > 0.1


@both_robots
@pytest.mark.parametrize("history", [0, 2])
@pytest.mark.parametrize("normalised", [False, True])
def test_file_round_trip(tmp_path, robot, history, normalised):
    policy = random_policy(robot, "sincos", "tanh", history=history)
    if normalised:
        moments = {"mean": (1 / 3,) * 6, "std": (2 / 3,) * 6, "clip": 10.0}
        view = dataclasses.replace(policy.observation, **moments)
        policy = policy.replace(observation=view, squash="clip")
    path = tmp_path / "policy.npz"
    save_policy(path, policy, {"seed": 7})
    loaded = load_policy(path, robot=robot)
    assert jax.tree.structure(loaded) == jax.tree.structure(policy)
    jax.tree.map(np.testing.assert_array_equal, loaded, policy)
    assert read_header(path)["provenance"] == {"seed": 7}
    assert list(tmp_path.iterdir()) == [path]
    with np.load(path, allow_pickle=False) as arrays:
        assert all(value.dtype != object for value in arrays.values())


def write_first_format(path, policy):
    """A policy file as jaxpend 0.1 wrote it."""
    header = {
        "format": 1, "robot": policy.robot, "torque_limit": 3.0, "activation": policy.activation,
        "observation": dataclasses.asdict(policy.observation), "control_dt": 0.01,
        "layers": [policy.layers[0][0].shape[0], *(len(bias) for _, bias in policy.layers)],
        "provenance": {"seed": 7},
    }  # fmt: skip
    arrays = {}
    for i, (kernel, bias) in enumerate(policy.layers):
        arrays |= {f"kernel{i}": kernel, f"bias{i}": bias}
    np.savez(path, header=np.array(json.dumps(header)), **arrays)


def test_files_of_the_first_format_still_load(tmp_path):
    path, policy = tmp_path / "policy.npz", random_policy()
    write_first_format(path, policy)
    jax.tree.map(np.testing.assert_array_equal, load_policy(path), policy)
    assert read_header(path)["provenance"] == {"seed": 7}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a, h: h.update(format=99), "has policy format 99"),
        (lambda a, h: h.pop("torque_limit"), "not hold a whole controller: 'torque_limit'"),
        (lambda a, h: a.pop("kernel1"), "not hold a whole controller: 'kernel1'"),
        (lambda a, h: h.update(layers=[6, 16, 9, 1]), "do not have the shapes"),
        (lambda a, h: a.update(bias0=np.zeros(3, "f4")), "do not have the shapes"),
        (lambda a, h: a.update(bias1=a["bias1"] * np.nan), "not finite or not positive"),
        (lambda a, h: h.update(torque_limit=0.0), "not finite or not positive"),
        (lambda a, h: h.update(robot="cartpole"), "unknown robot 'cartpole'"),
        (lambda a, h: h.update(activation="exp"), "unknown activation 'exp'"),
        (
            lambda a, h: h["observation"].update(kind="pixels"),
            "be wrapped, sincos, sincos_clip",
        ),
        (lambda a, h: h["observation"].update(mean=[0.0]), "mean is (0.0,); it must be 6 values"),
        (lambda a, h: h.update(control_dt=-1.0), "the control period is -1.0 s; it must be in"),
        (lambda a, h: h.update(control_dt=float("nan")), "the control period is nan s"),
        (lambda a, h: h.update(control_dt=1e9), "the control period is 1000000000.0 s"),
        (lambda a, h: a.update(bias1=a["bias1"] + np.inf), "not finite or not positive"),
        (lambda a, h: h.update(layers="6"), "does not hold a whole controller"),
        (lambda a, h: h.update(layers=[6, 10**9, 1]), "do not have the shapes"),
        (lambda a, h: h.update(observation=[1]), "does not hold a whole controller"),
        (lambda a, h: h.update(robot=["pendubot"]), "does not hold a whole controller"),
    ],
)
def test_damaged_contents_are_one_sentence(tmp_path, change, words):
    path = tmp_path / "policy.npz"
    write_first_format(path, random_policy())
    rewrite(path, change)
    with refused(words):
        load_policy(path)


@pytest.mark.parametrize("kept", [0, 10, 0.5, 0.95])
def test_empty_and_cut_off_files_are_one_sentence(tmp_path, kept):
    path = tmp_path / "policy.npz"
    save_policy(path, random_policy())
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept if kept > 1 else kept * len(whole))])
    with pytest.raises(JaxpendError, match="is not a policy file, or it is empty or cut off"):
        load_policy(path)


def test_pickled_files_are_refused(tmp_path):
    path = tmp_path / "policy.npz"
    np.savez(path, header=np.array([{"robot": "acrobot"}], dtype=object))
    with pytest.raises(JaxpendError, match="is not a policy file"):
        load_policy(path)


def test_missing_files_and_the_other_robots_policy(tmp_path):
    with pytest.raises(JaxpendError, match="there is no policy file"):
        load_policy(tmp_path / "nothing.npz")
    path = tmp_path / "policy.npz"
    save_policy(path, random_policy("acrobot"))
    with pytest.raises(JaxpendError, match="a policy for the acrobot, not for the pendubot"):
        load_policy(path, robot="pendubot")


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_velocity_scale_must_be_positive(scale):
    with pytest.raises(JaxpendError, match="must be positive"):
        Observation("sincos", scale)


def test_history_must_not_be_negative():
    with pytest.raises(JaxpendError, match="history is -1; it must not be negative"):
        Observation(history=-1)


def test_an_unknown_way_to_squash_is_refused(tmp_path):
    path = tmp_path / "policy.npz"
    save_policy(path, random_policy())
    rewrite(path, lambda _, header: header["controller"]["fields"].update(squash="sine"))
    with refused("unknown squash 'sine'; known: tanh, clip", start=str(path)):
        load_policy(path)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_policy_that_ships_is_one_of_its_robot(name):
    policy = load_policy(name)
    assert robot_of(policy) == name.rpartition("_")[2]
    command = read_header(name)["provenance"]["command"]
    assert command.startswith("jaxpend")
    assert "/tmp" not in command

"""Actor and critics: the density of the squashed Gaussian, and the policy made from an actor."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from conftest import assert_close, both_robots
from hypothesis import given
from hypothesis import strategies as st

from jaxpend.boards import v2
from jaxpend.designs import active_joint
from jaxpend.env import Env, EnvConfig
from jaxpend.observation import Observation
from jaxpend.sac.critics import HistogramCritic, TwinCritic
from jaxpend.sac.losses import histogram
from jaxpend.sac.networks import Actor, constant_log_std, squashed, to_policy
from jaxpend.sac.replay import Transition

STATES = np.random.default_rng(0).normal(size=(5, 4)).astype("f4") * [1, 2, 4, 8]
OBS, BEFORE = np.split(np.random.default_rng(1).normal(size=(5, 7)).astype("f4"), [6], axis=1)
ACTIONS = np.array([-0.9, -0.3, 0.0, 0.4, 0.8], "f4")
sample = jax.jit(squashed)


@pytest.fixture(scope="module")
def actor():
    """A small actor and its parameters, log standard deviations spread out over observations."""
    net = Actor((16, 8), "tanh")
    params = net.init(jax.random.key(0), OBS)
    params["params"]["log_std"]["bias"] += 0.3
    return net, params


def draws(mean, log_std, count=20_000):
    """Actions and log-probabilities of many samples from one distribution, float64."""
    shape = (count, 1)
    dtype = jnp.result_type(float)
    mean, log_std = jnp.full(shape, mean, dtype), jnp.full(shape, log_std, dtype)
    action, log_prob = sample(mean, log_std, jax.random.normal(jax.random.key(1), shape, dtype))
    return np.asarray(action), np.asarray(log_prob)


@pytest.mark.x64
@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (0.8, -1.0), (-1.5, -0.3)])
def test_log_probability_is_a_density_of_the_action(mean, log_std):
    action, log_prob = draws(mean, log_std)
    order = np.argsort(action)
    mass = np.trapezoid(np.exp(log_prob[order]), action[order])
    np.testing.assert_allclose(mass, 1.0, atol=2e-3)
    # The change of variables from the sample v before the tanh, and v's own distribution.
    v, std = np.arctanh(action), np.exp(log_std)
    normal = -(((v - mean) / std) ** 2) / 2 - log_std - np.log(2 * np.pi) / 2
    np.testing.assert_allclose(log_prob, normal - np.log(1 - action**2), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose([v.mean(), v.std()], [mean, std], atol=0.04)


def test_log_probability_stays_finite_and_right_where_the_tanh_saturates():
    mean = jnp.array([[-60.0], [-12.0], [12.0], [60.0]])
    log_std = jnp.full((4, 1), -4.0)
    noise = jax.random.normal(jax.random.key(0), (4, 1))

    def both(mean):
        action, log_prob = squashed(mean, log_std, noise)
        return log_prob.sum(), (action, log_prob)

    slope, (action, log_prob) = jax.jit(jax.grad(both, has_aux=True))(mean)
    assert_close(np.abs(action), np.ones(4))
    # log(1 - tanh(v)^2) tends to 2 log 2 - 2 |v|, whose slope is -2 sign(v).
    normal = -(noise**2) / 2 + 4 - jnp.log(2 * jnp.pi) / 2
    v = mean + jnp.exp(-4.0) * noise
    assert_close(log_prob, (normal + 2 * jnp.abs(v) - 2 * jnp.log(2.0))[:, 0])
    assert_close(slope, 2 * np.sign(mean))


def test_actor_sees_every_entry_of_the_observation(actor):
    net, params = actor
    apply = jax.jit(net.apply)
    for i in range(6):
        moved = apply(params, OBS + np.eye(6, dtype="f4")[i])
        assert not np.allclose(moved[0], apply(params, OBS)[0])


def test_log_standard_deviation_is_bounded(actor):
    net, params = actor
    far = params["params"] | {
        "log_std": jax.tree.map(lambda w: 1e4 * w, params["params"]["log_std"])
    }
    _, log_std = net.apply({"params": far}, np.concatenate([OBS, -OBS]))
    assert set(np.unique(log_std)) == {-10.0, 2.0}


def test_constant_log_std_changes_nothing_else(actor):
    net, params = actor
    mean, before = net.apply(params, OBS)
    same_mean, log_std = net.apply(constant_log_std(params, -2.5), OBS)
    np.testing.assert_array_equal(same_mean, mean)
    np.testing.assert_array_equal(log_std, np.full((5, 1), -2.5, "f4"))
    assert before.std() > 0.01


@pytest.mark.parametrize("layer_norm", [False, True])
def test_critics_are_two_and_see_everything_and_the_lower_counts(layer_norm):
    critic = TwinCritic((8,), "relu", layer_norm)
    params = critic.init(jax.random.key(0), OBS, BEFORE, ACTIONS)
    apply, now = jax.jit(critic.both), (OBS, BEFORE, ACTIONS)
    q = apply(params, *now)
    assert q.shape == (5, 2)
    assert not np.allclose(q[:, 0], q[:, 1])
    np.testing.assert_array_equal(jax.jit(critic.value)(params, *now), q.min(axis=1))
    for other in ((OBS + 0.1, BEFORE, ACTIONS), (OBS, BEFORE + 1, ACTIONS),
                  (OBS, BEFORE, -ACTIONS - 0.1)):  # fmt: skip
        assert np.all(np.any(q != apply(params, *other), axis=0))
    # Parameters of the first do not move the second.
    first = {k: v for k, v in params["params"].items() if k in ("Trunk_0", "Dense_0")}
    moved = params["params"] | jax.tree.map(lambda w: w + 0.5, first)
    moved = apply({"params": moved}, *now)
    np.testing.assert_array_equal(moved[:, 1], q[:, 1])
    assert np.all(moved[:, 0] != q[:, 0])
    assert ("LayerNorm_0" in params["params"]["Trunk_0"]) == layer_norm


def test_distributional_critics_are_two_and_their_means_lie_between_the_ends():
    critic = HistogramCritic((8,), "relu", True, 11, (-2.0, 3.0))
    params = critic.init(jax.random.key(0), OBS, BEFORE, ACTIONS)
    now = (params, OBS, BEFORE, ACTIONS)
    logits = jax.jit(critic.logits)(*now)
    assert logits.shape == (5, 2, 11)
    means = critic.means(logits)
    np.testing.assert_allclose(jax.jit(critic.value)(*now), means.min(axis=-1), rtol=1e-5)
    assert not np.allclose(means[:, 0], means[:, 1])
    # All in one bin: its middle.
    middles = np.linspace(-2, 3, 12)[:-1] + 2.5 / 11
    sure = critic.means(jnp.where(jnp.eye(11, dtype=bool), 100.0, 0.0))
    np.testing.assert_allclose(sure, middles, rtol=1e-4, atol=1e-5)


@given(st.floats(-50, 50), st.sampled_from([2, 11, 60]))
def test_a_histogram_of_a_target_is_a_distribution_about_it(target, bins):
    edges = jnp.linspace(-10.0, 10.0, bins + 1)
    (share,) = histogram(jnp.asarray([target]), edges)
    assert share.min() >= 0
    np.testing.assert_allclose(share.sum(), 1, atol=1e-5)
    width = 20 / bins
    if abs(target) < 10 - 3 * width:  # the whole bell is between the ends
        mean = share @ ((edges[1:] + edges[:-1]) / 2)
        np.testing.assert_allclose(mean, target, atol=0.05 * width)
    if abs(target) > 10:
        assert share.argmax() == (bins - 1 if target > 0 else 0)


def test_distributional_critics_learn_the_soft_target():
    critic = HistogramCritic((32,), "relu", True, 51, (-4.0, 4.0))
    params = critic.init(jax.random.key(0), OBS, BEFORE, ACTIONS)
    one = Transition(OBS, BEFORE, ACTIONS, jnp.arange(-2.0, 3.0), OBS, BEFORE)
    optimizer, cost = optax.adam(1e-2), jnp.full(5, 0.5)

    @jax.jit
    def step(params, state):
        (loss, _), slope = jax.value_and_grad(critic.loss, has_aux=True)(
            params, params, one, ACTIONS, cost, 0.0
        )
        updates, state = optimizer.update(slope, state)
        return optax.apply_updates(params, updates), state, loss

    state = optimizer.init(params)
    for _ in range(400):
        params, state, _ = step(params, state)
    found = critic.means(critic.logits(params, OBS, BEFORE, ACTIONS))
    np.testing.assert_allclose(found, np.arange(-2.0, 3.0)[:, None] * [1, 1], atol=0.1)


@both_robots
@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("kind", ["wrapped", "sincos"])
def test_policy_acts_as_the_actors_mean(robot, activation, kind):
    config = EnvConfig(torque_limit=2.5, dt=0.02, observation=Observation(kind))
    env, zero = Env(config, v2(robot).task), jnp.zeros(())
    obs = jax.vmap(lambda x: env.observe(x, zero, None, None, zero).obs)(STATES)
    net = Actor((16, 8), activation)
    params = net.init(jax.random.key(0), obs)
    policy = to_policy(params, net, env)
    torque = jax.vmap(lambda x: policy((None, None), 0.0, x)[1])(STATES)
    mean, _ = net.apply(params, obs)
    assert_close(torque[:, active_joint(robot)], 2.5 * np.tanh(mean[:, 0]), times=5)
    assert not torque[:, 1 - active_joint(robot)].any()
    assert np.abs(torque).max() > 0.05
    assert (policy.robot, policy.control_dt, policy.activation) == (robot, 0.02, activation)

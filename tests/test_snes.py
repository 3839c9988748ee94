"""SNES: the sign, the noise that all share, what is searched, and what a lost run counts for."""

import dataclasses
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, refused, shipped_network, task_of

from jaxpend import Policy, designs, snes
from jaxpend.config import Objective, Strategy
from jaxpend.controllers import load_reference, lqr, tvlqr
from jaxpend.controllers.hybrid import with_lqr
from jaxpend.score import Criteria, official, performance, score_v2
from jaxpend.snes import SNESConfig

KEY = jax.random.key(0)
TASK = task_of("pendubot")
NETWORK = shipped_network()
TOY = Policy(
    layers=((jnp.zeros((6, 3)), jnp.zeros(3)), (jnp.zeros((3, 1)), jnp.zeros(1))),
    torque_limit=jnp.asarray(3.0),
)


def distance(policy):
    """Squared distance of the parameters to 0.1."""
    return sum(jnp.sum((leaf - 0.1) ** 2) for leaf in jax.tree.leaves(policy.layers))


@pytest.fixture
def toy_fitness(monkeypatch):
    """A fitness that is largest where every parameter is 0.1, with one noise a generation."""

    def fitness(config, policy, key, task):
        return jax.random.normal(key) - distance(policy), jnp.zeros((), jnp.int32)

    monkeypatch.setattr(snes, "fitness", fitness)
    snes.evolve.clear_cache()
    yield
    snes.evolve.clear_cache()


def evolved(config, policy, generations):
    """State and metrics after some generations."""
    return snes.evolve(config, policy, snes.init(config, policy, KEY), generations, TASK)


@pytest.mark.parametrize("strategy", get_args(Strategy))
def test_every_strategy_starts_at_the_controller_and_shrinks_as_told(toy_fitness, strategy):
    config = SNESConfig(
        generations=4, population=6, sigma=0.02, gain_sigma=0.05, final_sigma=1e-3,
        strategy=strategy,
    )  # fmt: skip
    start = TOY.replace(layers=jax.tree.map(lambda leaf: leaf + 0.3, TOY.layers))
    state = snes.init(config, start, KEY)
    for centre in (snes.mean_controller, snes.best_controller):
        jax.tree.map(assert_close, centre(config, start, state), start)
    before = state
    state, metrics = snes.evolve(config, start, state, 4, TASK)
    # Else it would be compiled a second time, for the second chunk.
    assert jax.tree.map(jax.typeof, state) == jax.tree.map(jax.typeof, before)
    # From 0.02 to a thousandth of it; they adapt sigma as well, and Open-ES is a generation late.
    assert 2e-6 < metrics["sigma"][-1] < 2e-4


@pytest.mark.parametrize("strategy", get_args(Strategy))
def test_the_search_climbs_the_fitness(toy_fitness, strategy):
    # Open-ES moves by a tenth of sigma a generation.
    generations = 100 if strategy == "open_es" else 40
    config = SNESConfig(generations=generations, population=20, sigma=0.03, strategy=strategy)
    state, _ = evolved(config, TOY, generations)
    found = snes.mean_controller(config, TOY, state)
    assert distance(found) < 0.2 * distance(TOY)
    assert np.mean(np.asarray(found.layers[0][0])) > 0.05


def test_lm_ma_es_remembers_where_the_good_ones_were(toy_fitness):
    config = SNESConfig(population=20, sigma=0.03, strategy="lm_ma_es")
    begun = snes.init(config, TOY, KEY)
    state, _ = snes.evolve(config, TOY, begun, 1, TASK)
    moved, memory = state.strategy.mean - begun.strategy.mean, state.strategy.M[0]
    along = jnp.dot(moved, memory) / jnp.linalg.norm(moved) / jnp.linalg.norm(memory)
    assert_close(along, 1.0, times=10)


def test_best_individual_is_the_one_with_the_best_fitness_so_far(toy_fitness):
    config = SNESConfig(generations=5, population=6)
    state, metrics = snes.init(config, TOY, KEY), []
    for _ in range(5):
        state, row = snes.evolve(config, TOY, state, 1, TASK)
        assert row["max_fitness"] >= row["mean_fitness"]
        metrics.append(float(row["max_fitness"][0]))
        assert_close(state.best_fitness, max(metrics))
    best = snes.best_controller(config, TOY, state)
    # The noise is one number a generation, the rest is the distance.
    offset = [float(state.best_fitness + distance(best)), *metrics]
    assert np.isfinite(offset).all()
    assert distance(best) < 1.1 * distance(TOY)


def test_groups_change_nothing(toy_fitness, monkeypatch):
    """Large networks are judged a few at a time, so that their weights stay near."""
    assert [snes._group(40, size) for size in (100, 17_000, 67_000, 10**9)] == [40, 10, 4, 1]
    assert snes._group(7, 200_000) == 1
    config = SNESConfig(generations=3, population=6)
    at_once, _ = evolved(config, TOY, 3)
    monkeypatch.setattr(snes, "NEAR", 4 * 25 * 2.5)  # two networks of 25 numbers
    snes.evolve.clear_cache()
    assert snes._group(6, 25) == 2
    jax.tree.map(assert_close, evolved(config, TOY, 3)[0].strategy.mean, at_once.strategy.mean)


def test_only_what_is_searched_changes(toy_fitness):
    for searched in ("all", "hidden"):
        config = SNESConfig(generations=3, population=4, searched=searched)
        state, _ = evolved(config, TOY, 3)
        for centre in (snes.mean_controller, snes.best_controller):
            found = centre(config, TOY, state)
            assert jax.tree.structure(found) == jax.tree.structure(TOY)
            assert np.all(np.asarray(found.layers[0][0]) != 0)
            assert np.all(np.asarray(found.layers[0][1]) != 0)
            changed = [bool(np.any(np.asarray(leaf) != 0)) for leaf in found.layers[1]]
            assert changed == [searched == "all"] * 2


def test_gains_are_searched_in_units_of_themselves(monkeypatch):
    """The optimum is 20 % above every gain; weights and gains start with a sigma of their own."""
    start = with_lqr(TOY, designs.competition("pendubot"), "pendubot")

    def fitness(config, found, key, task):
        assert task == TASK
        ratio = found.top.gain[0] / (1.2 * start.top.gain[0])
        return -jnp.sum(jnp.log(ratio) ** 2), jnp.zeros((), jnp.int32)

    monkeypatch.setattr(snes, "fitness", fitness)
    snes.evolve.clear_cache()
    config = SNESConfig(generations=30, population=20, sigma=0.02, gain_sigma=0.05)
    state = snes.init(config, start, KEY)
    assert_close(state.strategy.std, np.repeat([0.02, 0.05], [25, 10]))
    state, _ = snes.evolve(config, start, state, 30, TASK)
    snes.evolve.clear_cache()
    for centre in (snes.mean_controller, snes.best_controller):
        found = centre(config, start, state)
        assert jax.tree.structure(found) == jax.tree.structure(start)
        np.testing.assert_allclose(found.top.gain[0] / start.top.gain[0], 1.2, atol=0.06)
        np.testing.assert_array_equal(found.top.gain[1], 0.0)


def test_sigma_decays_to_its_final_fraction(monkeypatch):
    def flat(config, policy, key, task):
        return jnp.zeros(()), jnp.zeros((), jnp.int32)

    monkeypatch.setattr(snes, "fitness", flat)
    sigmas = {}
    for final in (1.0, 0.25):
        snes.evolve.clear_cache()
        config = SNESConfig(generations=8, population=4, sigma=0.02, final_sigma=final)
        assert_close(snes.init(config, TOY, KEY).strategy.std, np.full(25, 0.02))
        sigmas[final] = np.asarray(evolved(config, TOY, 8)[1]["sigma"])
    snes.evolve.clear_cache()
    # The search adapts sigma too; the schedule is what differs.
    assert_close(sigmas[0.25] / sigmas[1.0], 0.25 ** (np.arange(1, 9) / 8), times=10)


def test_an_individual_that_is_nan_is_last_and_counted_and_poisons_nothing(monkeypatch):
    def fitness(config, policy, key, task):
        sick = policy.layers[0][1][0] > 0
        kernel = jnp.where(sick, jnp.nan, policy.layers[0][0])
        layers = ((kernel, policy.layers[0][1]), policy.layers[1])
        brief = dataclasses.replace(task, duration=0.02)
        c = performance(policy.replace(layers=layers), task.plant, key, brief)
        score = score_v2(dataclasses.replace(c, swingup_time=0.0, success=c.tau_cost >= 0))
        return score, jnp.sum(~jnp.isfinite(c.velocity_cost))

    monkeypatch.setattr(snes, "fitness", fitness)
    snes.evolve.clear_cache()
    config = SNESConfig(generations=4, population=10, sigma=0.05)
    state, metrics = evolved(config, TOY, 4)
    snes.evolve.clear_cache()
    assert 0 < state.diverged < 40
    assert np.isfinite(state.strategy.mean).all()
    assert np.isfinite(state.best_fitness)
    assert np.all(metrics["mean_fitness"] > 0)
    # The search walks away from where individuals are lost.
    assert snes.mean_controller(config, TOY, state).layers[0][1][0] < 0


def lost(policy):
    """A policy whose torque overflows."""
    return policy.replace(torque_limit=jnp.asarray(jnp.nan, jnp.float32))


@pytest.fixture(scope="module")
def fit():
    """``snes.fitness``, jitted."""
    return jax.jit(snes.fitness, static_argnums=(0, 3))


QUIET = SNESConfig(action_noise=0.0, rollouts=3)


def test_fitness_without_noise_is_the_official_score(fit):
    score, diverged = fit(QUIET, NETWORK, KEY, TASK)
    np.testing.assert_allclose(score, official(NETWORK, "pendubot")["score"], atol=2e-3)
    assert diverged == 0
    np.testing.assert_array_equal(fit(QUIET, NETWORK, jax.random.key(1), TASK)[0], score)
    score, diverged = fit(QUIET, lost(NETWORK), KEY, TASK)
    assert (float(score), int(diverged)) == (0.0, 1)


def test_fitness_is_the_mean_over_rollouts_with_noisy_actions(fit):
    config = SNESConfig(action_noise=0.05, rollouts=2)
    score, diverged = fit(config, NETWORK, KEY, TASK)
    quiet, _ = fit(QUIET, NETWORK, KEY, TASK)
    assert 0 < score < quiet - 0.01  # noise costs smoothness
    assert diverged == 0
    np.testing.assert_array_equal(fit(config, NETWORK, KEY, TASK)[0], score)
    assert fit(config, NETWORK, jax.random.key(1), TASK)[0] != score
    # Lost runs are worth nothing, and each of them is counted.
    score, diverged = fit(config, lost(NETWORK), KEY, TASK)
    assert (float(score), int(diverged)) == (0.0, 2)


def test_scenarios_have_their_weight_in_the_fitness(monkeypatch):
    perfect = Criteria(*jnp.zeros((9, 5)), success=jnp.arange(5) > 1)  # score 1 in three of five

    def imperfect(controller, task, key, count):
        assert controller is NETWORK
        assert count == 5
        return perfect, jnp.arange(5) > 3

    monkeypatch.setattr(snes, "imperfect", imperfect)
    nominal = official(NETWORK, "pendubot")["score"]
    for outcome, mean in (("score", 0.6), ("success", 0.2)):
        config = dataclasses.replace(QUIET, scenarios=5, objective=Objective(0.25, outcome))
        score, _ = jax.jit(partial(snes.fitness, config, NETWORK, task=TASK))(KEY)
        np.testing.assert_allclose(score, 0.75 * nominal + 0.25 * mean, atol=2e-3)


def test_any_controller_has_a_fitness_and_only_policies_have_action_noise(fit):
    plant = designs.competition("pendubot")
    noisy = SNESConfig(action_noise=0.3, rollouts=2)
    hybrid = with_lqr(NETWORK, plant, "pendubot")
    quiet, _ = fit(QUIET, hybrid, KEY, TASK)
    np.testing.assert_allclose(quiet, official(hybrid, "pendubot")["score"], atol=2e-3)
    assert 0 < fit(noisy, hybrid, KEY, TASK)[0] < quiet - 0.01
    # No policy, no noise: one rollout, that counts once if it is lost.
    tracking = tvlqr(plant, load_reference("pendubot"))
    score, diverged = fit(noisy, tracking, KEY, TASK)
    np.testing.assert_allclose(score, official(tracking, "pendubot")["score"], atol=2e-3)
    sick = tracking.replace(gain=tracking.gain * jnp.nan)
    score, diverged = fit(noisy, sick, KEY, TASK)
    assert (float(score), int(diverged)) == (0.0, 1)


def test_a_generation_meets_one_noise_and_improves_the_policy(fit):
    off = shipped_network(bias=0.05)
    config = SNESConfig(generations=10, population=12, sigma=0.003, action_noise=0.02)
    # Common random numbers: individuals that are equal to rounding are equally fit.
    alike = snes.init(dataclasses.replace(config, sigma=1e-20), off, KEY)
    _, metrics = snes.evolve(config, off, alike, 10, TASK)
    np.testing.assert_allclose(metrics["max_fitness"], metrics["mean_fitness"], rtol=1e-6)
    assert len(np.unique(metrics["max_fitness"])) == 10  # new noise in every generation
    state, metrics = evolved(dataclasses.replace(config, generations=25, sigma=0.001), off, 25)
    means = np.asarray(metrics["mean_fitness"])
    assert means[-3:].mean() > means[:3].mean() + 0.003
    found = snes.mean_controller(config, off, state)
    assert fit(QUIET, found, KEY, TASK)[0] > fit(QUIET, off, KEY, TASK)[0]
    assert state.diverged == 0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"population": 1}, "population is 1; it must be at least 2"),
        ({"population": 0}, "population is 0; it must be at least 2"),
        ({"sigma": 0.0}, "sigma is 0.0; it must be positive"),
        ({"action_noise": -0.1}, "action_noise is -0.1; it must not be negative"),
        ({"action_noise": float("nan")}, "action_noise is nan; it must not be negative"),
        ({"gain_sigma": 0.0}, "gain_sigma is 0.0; it must be positive"),
        ({"strategy": "ga"}, "strategy is 'ga'; it must be snes, sep_cma_es, lm_ma_es or"),
        ({"strategy": "open_es", "population": 5}, "population is 5; open_es needs pairs"),
        ({"scenarios": -1}, "scenarios is -1; it must not be negative"),
        ({"scenarios": 4}, "scenarios is 4; with objective.weight 0 they count nothing"),
    ],
)
def test_senseless_values_are_one_sentence(values, words):
    with refused(words):
        SNESConfig(**values)


def test_the_task_may_be_left_out_where_the_controller_knows_its_robot(toy_fitness):
    config = SNESConfig(generations=1, population=4)
    named, _ = evolved(config, TOY, 1)
    known, _ = snes.evolve(config, TOY, snes.init(config, TOY, KEY), 1)
    np.testing.assert_array_equal(known.strategy.mean, named.strategy.mean)
    holding = lqr(designs.competition("pendubot"), "pendubot")
    with refused("LQR does not know its robot; give a task, as v2(robot).task"):
        snes.evolve(config, holding, snes.init(config, holding, KEY), 1)

"""Stages: what candidates are compared by."""

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import shipped_network

from jaxpend.config import GradientConfig, SNESConfig
from jaxpend.score import Criteria, nominal, score_v2
from jaxpend.train import stages


@pytest.fixture
def met(monkeypatch):
    """How many scenarios were met; three of four of them end with score 1, the others with 0."""
    counts = []

    def imperfect(controller, plant, key, count):
        counts.append(count)
        return Criteria(*jnp.zeros((9, count)), success=jnp.arange(count) % 4 > 0)

    monkeypatch.setattr(stages, "imperfect", imperfect)
    stages._validation.clear_cache()
    yield counts
    stages._validation.clear_cache()


@pytest.mark.parametrize(
    ("kind", "config"),
    [
        (stages.Gradient, GradientConfig(scenarios=2, scenario_weight=0.25, validation=8)),
        (stages.Gradient, GradientConfig()),
        (stages.SNES, SNESConfig(population=2, action_noise=0.0)),
    ],
)
def test_candidates_are_compared_by_score_and_by_scenarios_that_stay_the_same(met, kind, config):
    policy = shipped_network()
    stage = kind(config, policy, "pendubot")
    row, candidates = stage.judge(stage.start(0, policy), {})
    expected = score = float(score_v2(nominal(policy, "pendubot")))
    if config.scenarios:
        expected = 0.75 * score + 0.25 * 0.75
    assert met == ([8] if config.scenarios else [])
    for _, worth in candidates:
        np.testing.assert_allclose(worth, expected, rtol=1e-5)
    found = row["score"] if kind is stages.Gradient else row["mean_score"]
    np.testing.assert_allclose(found, score, rtol=1e-5)


def test_scenarios_count_in_either_search(met):
    for config in (GradientConfig(scenarios=1), SNESConfig(scenarios=1)):
        weight = config.scenario_weight
        assert stages.value(config, None, 0.5, "acrobot") == 0.5 * (1 - weight) + 0.75 * weight
    assert met == [256]  # compiled once for both

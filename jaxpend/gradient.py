"""The analytic gradient of a smooth form of the official score, through the simulator.

The closed loop is differentiated from end to end, so that the effect of a parameter on the score
seconds later is computed and not estimated from samples. Adam (Kingma and Ba, 2015) climbs from a
trained policy, or from any other controller that declares what may be searched
(``controllers/search_space.py``),

    (1 - w) smooth v2 score of the nominal run + w mean upright time of random scenarios

The first is that of ``swingup.py``. The second is there only with ``config.scenarios``: the mean
over a run and over imperfect scenarios (``variations.sample``, new ones every step) of
``1 / (1 + d^2)``, d the distance to upright in units of what the benchmark calls a success.

Where motion is chaotic the gradient explodes and says nothing. Therefore the window is
``duration`` long, the norm of each run's gradient is clipped before they are averaged, a run
whose gradient is not finite is left out and counted, and in scenarios the effect of a state on
later states fades from the gradient, with the time constant ``memory``.
"""

import math
from functools import partial
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
import optax

from .boards import Task, own_task
from .config import GradientConfig, Run
from .controller import Controller, check_controller
from .controllers.search_space import coordinates
from .criteria import EPSILON
from .plant import rk4_step
from .pytree import Pytree, pytree
from .rollout import rollout
from .scenario import Scenario
from .stage import Candidates, Chart, Row, SearchStage, SearchState
from .trajopt.swingup import SwingUp, smooth_score, totals
from .variations import LONGEST_DELAY

__all__ = ["Gradient", "GradientConfig", "GradientState", "current", "improve", "init", "slope"]


@pytree
class GradientState(Pytree):
    """Everything that the ascent changes."""

    parameters: jax.Array  # (parameters,)
    optimizer: Any  # optax state
    key: jax.Array
    lost: jax.Array  # () int, runs whose gradient was not finite, so far


def _fading(memory: float):
    """``rk4_step``, across which a gradient fades with time constant ``memory`` (s)."""

    def integrate(plant, x, u, dt):
        x = rk4_step(plant, x, u, dt)
        held = jax.lax.stop_gradient(x)
        return held + math.exp(-dt / memory) * (x - held)

    return rk4_step if math.isinf(memory) else integrate


def performance(config: GradientConfig, controller: Controller, task: Task) -> jax.Array:
    """Smooth score of the first ``config.duration`` s of the nominal run."""
    run = rollout(task.plant, controller, jax.random.key(0), dt=task.dt, duration=config.duration)
    line, power = jnp.asarray(config.line_width), jnp.asarray(config.power_width)
    p = SwingUp(task.plant, None, None, line, power, task, task.dt)
    return smooth_score(p, totals(p, run.x, run.u[:, task.joint]))


def uprightness(x: jax.Array) -> jax.Array:
    """``1 / (1 + d^2)`` of states (..., 4), d the distance to upright in units of ``EPSILON``."""
    off = jnp.stack([2 * (1 + jnp.cos(x[..., 0])), 2 * (1 - jnp.cos(x[..., 1]))], axis=-1)
    off = jnp.concatenate([off, x[..., 2:] ** 2], axis=-1)
    return 1 / (1 + jnp.sum(off / jnp.asarray(EPSILON, x.dtype) ** 2, axis=-1))


def robustness(
    config: GradientConfig, controller: Controller, scenario: Scenario, key: jax.Array, task: Task
) -> jax.Array:
    """Mean uprightness of a run of ``config.scenario_duration`` s; ``key`` is consumed."""
    slots, integrator = LONGEST_DELAY + 1, _fading(config.memory)
    options = {"duration": config.scenario_duration, "integrator": integrator}
    run = rollout(scenario, controller, key, dt=task.dt, delay_slots=slots, **options)
    return uprightness(run.x).mean()


def _usable(config: GradientConfig, value, slope):
    """Value and clipped gradient of a run, zero if they are not finite, and whether they are."""
    norm = jnp.linalg.norm(slope)
    finite = jnp.isfinite(value) & jnp.isfinite(norm)
    scale = jnp.minimum(1.0, config.clip / jnp.where(norm > 0, norm, 1.0))
    return jnp.where(finite, value, 0.0), jnp.where(finite, scale * slope, 0.0), finite


def slope(config: GradientConfig, start: Controller, task: Task, z: jax.Array, key: jax.Array):
    """Gradient (n,) at the coordinates ``z`` (n,), how many runs were lost, and metrics.

    ``start`` is the origin of the coordinates; ``key`` is consumed.
    """
    rebuild = coordinates(start, config.searched)[-1]
    found = jax.value_and_grad(lambda z: performance(config, rebuild(z), task))(z)
    value, ascent, finite = _usable(config, *found)
    lost, metrics = 1 - finite.astype(jnp.int32), {"smooth_score": value}
    if not config.scenarios:
        return ascent, lost, metrics
    keys = jax.random.split(key, 2 * config.scenarios)
    scenarios = jax.vmap(task.sample)(keys[: config.scenarios])
    each = jax.value_and_grad(lambda z, s, k: robustness(config, rebuild(z), s, k, task))
    found = jax.vmap(each, in_axes=(None, 0, 0))(z, scenarios, keys[config.scenarios :])
    values, ascents, finite = jax.vmap(partial(_usable, config))(*found)
    weight, kept = config.scenario_weight, jnp.maximum(finite.sum(), 1)
    ascent = (1 - weight) * ascent + weight * ascents.sum(axis=0) / kept
    lost = lost + jnp.sum(~finite, dtype=jnp.int32)
    return ascent, lost, metrics | {"uprightness": values.sum() / kept}


def _adam(config: GradientConfig, weights: np.ndarray) -> optax.GradientTransformation:
    """Adam, warmed up, then with cosine decay; weights and all else have step sizes of their own.

    Adam's first steps are as long as later ones, even where the gradient is small; without a
    warm-up they destroyed the swing-up.
    """
    rates = np.where(weights, config.learning_rate, config.gain_learning_rate)
    decay = optax.warmup_cosine_decay_schedule(
        0.0, 1.0, config.steps // 10, config.steps, config.final_learning_rate
    )
    sizes = optax.stateless(lambda change, _: change * rates.astype(change.dtype))
    return optax.chain(optax.scale_by_adam(), optax.scale_by_schedule(decay), sizes)


def init(config: GradientConfig, controller: Controller, key: jax.Array) -> GradientState:
    """The state at the controller, before the first step. Raises as ``search_space.kinds``."""
    check_controller(controller)
    z, weights, _ = coordinates(controller, config.searched)
    return GradientState(z, _adam(config, weights).init(z), key, jnp.zeros((), jnp.int32))


@partial(jax.jit, static_argnames=("config", "steps", "task"))
def improve(
    config: GradientConfig,
    start: Controller,
    state: GradientState,
    steps: int,
    task: Task | None = None,
) -> tuple[GradientState, dict[str, jax.Array]]:
    """Some Adam steps; returns the state and metrics of each step (steps,).

    ``start`` is what ``init`` got: the origin of the coordinates, and all that is not searched.
    ``task`` may be left out for a controller that knows its robot (``boards.own_task``).
    """
    task = own_task(start, task)
    optimizer = _adam(config, coordinates(start, config.searched)[1])

    def step(state, _):
        key, key_now = jax.random.split(state.key)
        ascent, lost, metrics = slope(config, start, task, state.parameters, key_now)
        change, memory = optimizer.update(ascent, state.optimizer)
        state = GradientState(state.parameters + change, memory, key, state.lost + lost)
        return state, metrics | {"slope": jnp.linalg.norm(ascent)}

    return jax.lax.scan(step, state, length=steps)


def current(config: GradientConfig, start: Controller, state: GradientState) -> Controller:
    """The controller at the parameters that the ascent has reached."""
    return coordinates(start, config.searched)[-1](state.parameters)


class Gradient(SearchStage):
    """The stage of training: the ascent; what is judged, by ``stage.value``, is where it is."""

    name, title, unit, column = "gradient", "Gradient", "steps", "step"
    heading, scores = "after the gradient", ("score",)
    charts = (
        Chart("Official score", {"best so far": "best", "now": "score"}, "v2 score"),
        Chart("Smooth score", {"smooth score": "smooth_score"}, "of the nominal run"),
        Chart("Norm of the gradient", {"norm": "slope"}, log=True),
    )

    @classmethod
    def of(cls, run: Run, start: Controller | None, task: Task) -> Self | None:
        config = getattr(run, "gradient", None)
        return cls(config, start, task) if config and config.steps else None

    def begin(self, seed: int, controller: Controller) -> SearchState:
        key = jax.random.fold_in(jax.random.key(seed), 2)
        return SearchState(controller, init(self.config, controller, key), jnp.asarray(0))

    def search(self, states: list[SearchState], count: int) -> list[tuple[GradientState, Row]]:
        return [improve(self.config, s.start, s.search, count, self.task) for s in states]

    def judge(self, state: SearchState, metrics: Row) -> tuple[Row, Candidates]:
        policy = current(self.config, state.start, state.search)
        score, worth = self.compared(policy)
        row = {"score": score, "value": worth, "lost": int(state.search.lost)}
        return row | {name: values[-1] for name, values in metrics.items()}, [(policy, worth)]

    def note(self, row: Row) -> str:
        return f"smooth score {float(row['smooth_score']):.4f}  score {row['score']:.4f}"

    def watched(self, state: SearchState) -> jax.Array:
        return state.search.parameters


if __name__ == "__main__":
    from .cli.app import main

    main("gradient")

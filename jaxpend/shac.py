"""Short-horizon actor-critic: the gradient of how soon a thrown arm stands again.

SHAC (Xu et al., "Accelerated policy learning with parallel differentiable simulation", 2022, arXiv
2204.07137) for the v3 board, whose score is the share of a minute that the tip is above the line.
The closed loop is differentiated from end to end, as in ``gradient``, but through a minute with
fifteen throws there is no gradient that means anything. Therefore many arms live side by side. In
a step each of them moves on by a window of T seconds, and the policy climbs the mean over all arms
of

    1 / h  integral from 0 to T of exp(-t / h) up(x(t)) dt  +  exp(-T / h) V(x(T))

with ``up`` in [0, 1] a smooth form of "above the line", h the horizon, and V a critic of what
comes after the window: how much of the time, discounted likewise, the arm will be up. The critic
learns by TD(lambda) from the same windows. Then the arms are kicked a little, and some are thrown,
or put anywhere.

It climbs along the natural gradient (Kakade, "A natural policy gradient", 2001): of all steps that
change the actions as much, in the states of the windows, the one that gains most. Some directions
in the weights change what the arm does a thousand times as much as others, and Adam, whose steps
are of one size in every weight, either loses the arm along the first or stands still along the
others. A step is tried in the same windows before it is taken, whole or in part.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Self

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from . import devices
from .boards import own_task
from .config import Run, SHACConfig
from .controller import Controller, check_controller
from .controllers.policy import Policy
from .controllers.search_space import Rebuild, coordinates
from .env import anywhere
from .errors import JaxpendError
from .plant import UPRIGHT, tip_height
from .pytree import Pytree, pytree
from .resets import thrown
from .rollout import rollout
from .sac.networks import Params, Trunk
from .scenario import DT, Scenario
from .stage import Candidates, Chart, Row, SearchStage, SearchState
from .task import Task
from .variations import LONGEST_DELAY

__all__ = ["SHAC", "SHACConfig", "SHACState", "current", "improve", "init"]

FASTEST = 60.0  # rad/s; an arm that is faster is put elsewhere
LEARNED = 25  # times of a window that the critic learns at
LOOKED_AT = 12  # times of a window at which a change of the actions is measured
WARM_UP = 20  # steps of the actor, in which their size grows
SMOOTHED = 0.1  # how fast the mean of the gradients, along which a step leads, takes up a new one
DAMPING = 0.01  # what the square of a step counts beside what it changes in the actions
ITERATIONS = 10  # of the conjugate gradients
TRIED = (1.0, 0.5, 0.25)  # parts of a step; the best of them is taken


@pytree
class SHACState(Pytree):
    """Everything that the ascent changes."""

    parameters: jax.Array  # (parameters,)
    slope: jax.Array  # (parameters,) mean of the gradients so far, of the last ones above all
    critic: Params
    target: Params  # of the critic, following slowly
    critic_opt: Any  # optax state
    x: jax.Array  # (num_arms, 4) where the arms are
    key: jax.Array
    steps: jax.Array  # () int, so far, those of the critic alone among them
    lost: jax.Array  # () int, windows whose gradient was not finite, so far


class Value(nn.Module):
    """How much of the discounted time to come, (...) of 1, arms in states (..., 4) will be up."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        angles = jnp.stack([x[..., 0], x[..., 1], x[..., 0] + x[..., 1]], axis=-1)
        seen = jnp.concatenate([jnp.cos(angles), jnp.sin(angles), x[..., 2:] / 5.0], axis=-1)
        return nn.Dense(1)(Trunk(self.hidden, "silu")(seen))[..., 0]


def _value(config: SHACConfig, params: Params, x: jax.Array) -> jax.Array:
    found: Any = Value(config.critic_hidden).apply(params, x)
    return found


def up(config: SHACConfig, task: Task, x: jax.Array) -> jax.Array:
    """A smooth form of whether the tip is above the line, in [0, 1], of states (..., 4)."""
    length = task.plant.length
    above = tip_height(length, x) - task.height * length.sum()
    return jax.nn.sigmoid(above / config.line_width)


def window(config: SHACConfig, task: Task, x: jax.Array, key: jax.Array) -> Scenario:
    """What an arm meets from state ``x`` (4,) on: the nominal plant, or random imperfections."""
    if not config.randomised:
        return Scenario(task.plant, x0=x)
    scenario = task.imperfect(task.plant, key, config.randomised)
    assert scenario.delay is not None
    steps = jnp.round(scenario.delay * (DT / config.dt)).astype(jnp.int32)  # it counts in DT
    return scenario.replace(x0=x, delay=steps)


def ahead(
    config: SHACConfig, policy: Controller, critic: Params, scenario: Scenario, key: jax.Array,
    task: Task,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """What a window is worth (), and its states (T + 1, 4); ``key`` is consumed."""
    options: dict[str, Any] = {"dt": config.dt, "duration": config.window}
    if config.randomised:
        options["delay_slots"] = math.ceil(LONGEST_DELAY * DT / config.dt) + 1
    states = rollout(scenario, policy, key, **options).x
    decay = np.exp(-config.dt / config.horizon)
    worth = (1 - decay) * decay ** np.arange(len(states) - 1) @ up(config, task, states[1:])
    return worth + decay ** (len(states) - 1) * _value(config, critic, states[-1]), states


def targets(config: SHACConfig, critic: Params, x: jax.Array, task: Task) -> jax.Array:
    """What the critic should say in the states ``x`` (T + 1, 4) but the last: TD(lambda), (T,).

    ``config.trace`` is the time constant, s, with which what was seen counts less than what the
    critic says.
    """
    decay, trace = np.exp(-config.dt / config.horizon), np.exp(-config.dt / config.trace)

    def back(later, now):
        reward, value = now
        # G_t = (1 - g) r_t+1 + g ((1 - l) V(x_t+1) + l G_t+1)
        later = (1 - decay) * reward + decay * ((1 - trace) * value + trace * later)
        return later, later

    values = _value(config, critic, x[1:])
    steps = up(config, task, x[1:]), values
    return jax.lax.scan(back, values[-1], steps, reverse=True)[1]


def natural(rebuild: Rebuild, z: jax.Array, slope: jax.Array, x: jax.Array) -> jax.Array:
    """The step (parameters,) from ``z`` that climbs most, of those that change the actions by 1.

    That is s = F^-1 g, to scale: g is the ``slope``, and s' F s the mean square of what s changes
    in the actions in [-1, 1] in the states ``x`` (n, 4), to first order, plus ``DAMPING`` times
    the square of s. The equation is solved by conjugate gradients, as in TRPO (Schulman et al.,
    2015). ``rebuild`` makes the policy of parameters.
    """

    def actions(z: jax.Array) -> jax.Array:
        policy: Any = rebuild(z)
        return jax.vmap(lambda x: policy.greedy(policy.observation(x, None)))(x)

    _, change = jax.linearize(actions, z)
    back = jax.linear_transpose(change, z)

    def metric(step: jax.Array) -> jax.Array:
        return back(change(step))[0] / len(x) + DAMPING * step

    step, _ = jax.scipy.sparse.linalg.cg(metric, slope, maxiter=ITERATIONS)
    size = jnp.sqrt(jnp.maximum(step @ metric(step), 0.0))
    return step / jnp.where(size > 0, size, 1.0)


def _trust(config: SHACConfig, own: jax.Array) -> jax.Array:
    """How far the actor goes after so many steps of its own: warmed up, then with cosine decay."""
    last, steps = config.final_trust * config.trust, max(config.steps - config.critic_steps, 2)
    ramp = min(WARM_UP, steps - 1)
    found: Any = optax.warmup_cosine_decay_schedule(0.0, config.trust, ramp, steps, last)(own + 1)
    return found


def _critic_adam(config: SHACConfig) -> optax.GradientTransformation:
    return optax.adam(config.critic_learning_rate)


def check(controller: Controller, task: Task) -> None:
    """Raise ``JaxpendError`` for what this cannot improve, or a task whose score is another."""
    check_controller(controller)
    if not task.resets:
        text = "shac climbs the time that a thrown arm is up, the score of the v3 board"
        raise JaxpendError(f"{text}; this task has another score")
    if not isinstance(controller, Policy) or controller.observation.history:
        name = type(controller).__name__
        what = "one with a memory" if isinstance(controller, Policy) else name
        raise JaxpendError(f"shac needs a policy without memory and without a guard, not {what}")


def init(
    config: SHACConfig, controller: Controller, key: jax.Array, task: Task | None = None
) -> SHACState:
    """The state at the policy, before the first step, with a new critic; ``key`` is consumed.

    ``task`` is one with throws, as ``v3(robot).task``.

    Raises:
        JaxpendError: as ``check`` and ``search_space.kinds``.
    """
    task = own_task(controller, task)
    check(controller, task)
    z, _, _ = coordinates(controller, config.searched)
    key, key_critic, key_x = jax.random.split(key, 3)
    critic = Value(config.critic_hidden).init(key_critic, jnp.zeros(4))
    x = jax.vmap(partial(_thrown, task, jnp.array(UPRIGHT)))(
        jax.random.split(key_x, config.num_arms)
    )
    zero = jnp.zeros((), jnp.int32)
    memory, target = _critic_adam(config).init(critic), jax.tree.map(jnp.copy, critic)
    return SHACState(z, jnp.zeros_like(z), critic, target, memory, x, key, zero, zero)


def _thrown(task: Task, x: jax.Array, key: jax.Array) -> jax.Array:
    """Where a reset by hand leaves an arm in state ``x`` (4,)."""
    return thrown(task.with_resets(Scenario(task.plant), None).plant, key, task.dt, x)


def elsewhere(config: SHACConfig, task: Task, x: jax.Array, key: jax.Array) -> jax.Array:
    """Where an arm in state ``x`` (4,) goes on: kicked, or thrown, anywhere, or hanging."""
    key_which, key_thrown, key_hanging, key_size, key_kick, *keys = jax.random.split(key, 7)
    # What a critic says is right where it has been. An arm that stands is always in the same
    # place, and beside it V is anything, unless it is kicked; most of them only a little.
    spread = config.kicks * jnp.array([1.0, 1.0, 10.0, 10.0], x.dtype)
    spread = spread * jax.random.uniform(key_size) ** 2
    x = x + spread * jax.random.normal(key_kick, (4,), x.dtype)
    put = anywhere(*keys).astype(x.dtype)
    put = jnp.where(jax.random.bernoulli(key_hanging, 0.2), jnp.zeros_like(x), put)
    wild = ~jnp.all(jnp.isfinite(x)) | (jnp.abs(x[2:]).max() > FASTEST)
    chance = jax.random.uniform(key_which)
    moved = jnp.where(chance < config.thrown, _thrown(task, x, key_thrown), x)
    return jnp.where(wild | (chance > 1 - config.anywhere), put, moved)


def _learn(
    config: SHACConfig, state: SHACState, x: jax.Array, key: jax.Array, task: Task
) -> tuple[SHACState, jax.Array]:
    """The critic after some updates on windows ``x`` (num_arms, T + 1, 4), and its mean loss."""
    every = max((x.shape[1] - 1) // LEARNED, 1)
    goals = jax.vmap(lambda x: targets(config, state.target, x, task))(x)
    x, goals = x[:, :-1:every].reshape(-1, 4), goals[:, ::every].ravel()
    finite = jnp.isfinite(goals)
    x, goals = jnp.where(finite[:, None], x, 0.0), jnp.where(finite, goals, 0.0)
    count = min(config.critic_updates, len(finite))
    order = jax.random.permutation(key, len(finite))[: len(finite) // count * count]
    adam = _critic_adam(config)

    def update(carry, some):
        critic, memory = carry

        def loss(critic):
            off = _value(config, critic, x[some]) - goals[some]
            return jnp.mean(finite[some] * off**2)

        error, slope = jax.value_and_grad(loss)(critic)
        move, memory = adam.update(slope, memory)
        return (optax.apply_updates(critic, move), memory), error

    batches = order.reshape(count, -1)
    (critic, memory), errors = jax.lax.scan(update, (state.critic, state.critic_opt), batches)
    target = optax.incremental_update(critic, state.target, config.target_rate)
    return state.replace(critic=critic, critic_opt=memory, target=target), errors.mean()


def _climb(
    config: SHACConfig, rebuild: Rebuild, state: SHACState, slope: jax.Array, x: jax.Array,
    gained: Callable[[jax.Array], jax.Array],
) -> SHACState:  # fmt: skip
    """After a step of the policy, given the slope and the windows ``x`` (num_arms, T + 1, 4).

    ``gained`` says how much more than now other parameters are worth, (), in the same windows.
    """
    z, own = state.parameters, state.steps - config.critic_steps
    slope = optax.incremental_update(slope, state.slope, SMOOTHED)
    x = x[:, :: max((x.shape[1] - 1) // LOOKED_AT, 1)].reshape(-1, 4)
    step = natural(rebuild, z, slope, jnp.where(jnp.isfinite(x), x, 0.0))
    step = _trust(config, own) * step
    # Where it bends more than the slope can say, a part of the step is right, or nothing of it.
    parts = jnp.array(TRIED, z.dtype)
    gains = jax.lax.map(lambda part: gained(z + part * step), parts)
    z = z + jnp.where(gains.max() > 0, parts[gains.argmax()], 0.0) * step
    return state.replace(parameters=z, slope=slope)


@partial(jax.jit, static_argnames=("config", "steps", "task"))
def improve(
    config: SHACConfig,
    start: Controller,
    state: SHACState,
    steps: int,
    task: Task | None = None,
) -> tuple[SHACState, dict[str, jax.Array]]:
    """Some steps; returns the state and metrics of each step (steps,).

    ``start`` is what ``init`` got. In the first ``config.critic_steps`` of all the critic learns
    alone.
    """
    task = own_task(start, task)
    rebuild: Rebuild = coordinates(start, config.searched)[-1]

    def each(z: jax.Array, start: Any, critic: Params, x: jax.Array, key: jax.Array):
        policy: Any = coordinates(start, config.searched)[-1](z)
        key_met, key = jax.random.split(key)
        met = window(config, task, x, key_met)
        return ahead(config, policy.replace(action_noise=None), critic, met, key, task)

    axes = (None, None, None, 0, 0)
    windows = jax.vmap(jax.value_and_grad(each, has_aux=True), in_axes=axes)
    values = jax.vmap(lambda *args: each(*args)[0], in_axes=axes)

    def step(state: SHACState, _: None) -> tuple[SHACState, dict[str, jax.Array]]:
        key, key_critic, key_arms, key_windows = jax.random.split(state.key, 4)
        common = state.parameters, start, state.target
        keys = jax.random.split(key_windows, config.num_arms)
        (worth, x), slopes = devices.split(windows, *common)(state.x, keys)
        norm = jnp.linalg.norm(slopes, axis=1)
        usable = jnp.isfinite(norm) & jnp.isfinite(worth)
        scale = jnp.minimum(1.0, config.clip / jnp.where(norm > 0, norm, 1.0))
        slopes = jnp.where(usable[:, None], scale[:, None] * slopes, 0.0)
        slope = slopes.sum(axis=0) / jnp.maximum(usable.sum(), 1)

        def gained(z: jax.Array) -> jax.Array:
            found = devices.split(values, z, *common[1:])(state.x, keys) - worth
            return jnp.where(jnp.isfinite(found), found, 0.0).sum()

        climb = partial(_climb, config, rebuild, state, slope, x, gained)
        state = jax.lax.cond(state.steps >= config.critic_steps, climb, lambda: state)
        state, loss = _learn(config, state, x, key_critic, task)
        keys = jax.random.split(key_arms, config.num_arms)
        arms = jax.vmap(partial(elsewhere, config, task))(x[:, -1], keys)
        lost = state.lost + jnp.sum(~usable, dtype=jnp.int32)
        state = state.replace(x=arms, key=key, steps=state.steps + 1, lost=lost)
        metrics = {"up": jnp.nanmean(up(config, task, x)), "critic_loss": loss}
        return state, metrics | {"slope": jnp.linalg.norm(slope)}

    return jax.lax.scan(step, state, length=steps)


def current(config: SHACConfig, start: Controller, state: SHACState) -> Controller:
    """The policy at the parameters that the ascent has reached."""
    return coordinates(start, config.searched)[-1](state.parameters)


class SHAC(SearchStage):
    """The stage of training: the ascent; what is judged, by ``stage.value``, is where it is."""

    name, title, unit, column = "shac", "SHAC", "steps", "step"
    heading, scores = "after SHAC", ("score",)
    charts = (
        Chart("Official score", {"best so far": "best", "now": "score"}, "score"),
        Chart("Arms above the line", {"up": "up"}, "share of the time"),
        Chart("Loss of the critic", {"loss": "critic_loss"}, log=True),
    )

    def __init__(self, config: SHACConfig, policy: Any, task: Task):
        """Raises ``JaxpendError`` as ``init``."""
        super().__init__(config, policy, task)
        check(policy, task)

    @classmethod
    def of(cls, run: Run, start: Controller | None, task: Task) -> Self | None:
        config = getattr(run, "shac", None)
        return cls(config, start, task) if config and config.steps else None

    def begin(self, seed: int, controller: Controller) -> SearchState:
        key = jax.random.fold_in(jax.random.key(seed), 5)
        search = init(self.config, controller, key, self.task)
        return SearchState(controller, search, jnp.asarray(0))

    def search(self, states: list[SearchState], count: int) -> list[tuple[SHACState, Row]]:
        chunk = partial(improve, self.config, steps=count, task=self.task)
        chunk = partial(devices.compute, chunk)
        return [chunk(state.start, state.search) for state in states]

    def judge(self, state: SearchState, metrics: Row) -> tuple[Row, Candidates]:
        policy = current(self.config, state.start, state.search)
        score, worth = self.compared(policy)
        row: Row = {"score": score, "lost": int(state.search.lost)}
        return row | {name: values[-1] for name, values in metrics.items()}, [(policy, worth)]

    def note(self, row: Row) -> str:
        return f"up {float(row['up']):.3f}  score {row['score']:.4f}"

    def watched(self, state: SearchState) -> Any:
        return state.search.parameters, state.search.critic


if __name__ == "__main__":
    from .cli.app import main

    main("shac")

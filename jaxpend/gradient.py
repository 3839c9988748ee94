"""The analytic gradient of a smooth form of the official score, through the simulator.

The closed loop is differentiated from end to end. Adam (Kingma and Ba, 2015) climbs from a policy,
or another controller that declares what may be searched (``controllers/search_space.py``),

    (1 - w) smooth v2 score of the nominal run + w mean upright time of random scenarios
        - r mean squared change of the action

The first is that of ``swingup.py``. The second is there only with ``config.scenarios``: the mean
over a run and over imperfect scenarios (``variations.sample``, new ones every step) of
``1 / (1 + d^2)``, d the distance to upright in units of what the benchmark calls a success; w is
``config.objective.weight``. The third, with ``config.retention``, keeps what the policy does in
scenarios in which it stands already (``retention``).

Where motion is chaotic the gradient explodes and says nothing. Therefore the window is
``duration`` long, the norm of each run's gradient is clipped before they are averaged, a run
whose gradient is not finite is left out and counted, and in scenarios the effect of a state on
later states fades from the gradient, with the time constant ``memory``. An ascent that loses more
than ``tolerance`` of what it is worth goes back to its best, and on with half the rate: the smooth
score can rise while the swing-up is being lost.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from . import devices
from .boards import own_task
from .config import GradientConfig, Run, TrainRun
from .controller import Controller, check_controller
from .controllers.policy import Policy
from .controllers.search_space import coordinates
from .criteria import EPSILON, ScoreV2
from .errors import JaxpendError
from .plant import rk4_step
from .pytree import Pytree, pytree
from .retention import Retained, change, check_time, retained
from .rollout import rollout
from .scenario import Scenario
from .stage import Candidates, Chart, Row, SearchStage, SearchState, Stage, ranked
from .task import Task
from .trajopt.swingup import SwingUp, smooth_score, totals

__all__ = [
    "Gradient", "GradientConfig", "GradientState", "current", "improve", "init", "slope",
]  # fmt: skip


@pytree
class Reached(Pytree):
    """Where an ascent has been, and what that is worth."""

    parameters: jax.Array  # (parameters,)
    optimizer: Any  # optax state
    worth: jax.Array  # () as ``stage.value``; -inf: nobody has asked yet


@pytree
class GradientState(Pytree):
    """Everything that the ascent changes."""

    parameters: jax.Array  # (parameters,)
    optimizer: Any  # optax state
    key: jax.Array
    lost: jax.Array  # () int, runs whose gradient was not finite, so far
    rate: jax.Array  # () factor of the steps
    worth: jax.Array  # () of the parameters
    best: Reached
    retained: Retained | None = None  # with ``config.retention``


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
    options = {"duration": config.scenario_duration, "integrator": _fading(config.memory)}
    run = rollout(scenario, controller, key, dt=task.dt, delay_slots=task.delay_slots, **options)
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

    def each(z: jax.Array, start: Controller, scenario: Scenario, key: jax.Array) -> jax.Array:
        rebuild = coordinates(start, config.searched)[-1]
        return robustness(config, rebuild(z), scenario, key, task)

    every = jax.vmap(jax.value_and_grad(each), in_axes=(None, None, 0, 0))
    found = devices.split(every, z, start)(scenarios, keys[config.scenarios :])
    values, ascents, finite = jax.vmap(partial(_usable, config))(*found)
    weight, kept = config.objective.weight, jnp.maximum(finite.sum(), 1)
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


def init(
    config: GradientConfig, controller: Controller, key: jax.Array, task: Task | None = None
) -> GradientState:
    """The state at the controller, before the first step.

    ``task`` may be left out for a controller that knows its robot (``boards.own_task``).

    Raises:
        JaxpendError: as ``search_space.kinds``, or retention of what is not a policy alone, or
            of nothing, since a run is over before ``retained_after``.
    """
    check_controller(controller)
    z, weights, _ = coordinates(controller, config.searched)
    optimizer, worth = _adam(config, weights).init(z), jnp.asarray(-jnp.inf)
    rate, best = jnp.ones(()), Reached(z, optimizer, worth)
    state = GradientState(z, optimizer, key, jnp.zeros((), jnp.int32), rate, worth, best)
    if not config.retention:
        return state
    _check_retention(controller)
    task = own_task(controller, task)
    check_time(config.retained_after, task, "gradient")
    return state.replace(retained=retained(controller, config.retained_after, task))


def _check_retention(controller: Controller) -> None:
    if not isinstance(controller, Policy):
        text = "retention keeps actions of a network; it needs a policy without a guard, and not"
        raise JaxpendError(f"{text} {type(controller).__name__}")


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
    _, weights, rebuild = coordinates(start, config.searched)
    optimizer = _adam(config, weights)

    def step(state, _):
        key, key_now = jax.random.split(state.key)
        z = state.parameters
        ascent, lost, metrics = slope(config, start, task, z, key_now)
        if (kept := state.retained) is not None:
            key_kept = jax.random.fold_in(key_now, 1)
            found = jax.value_and_grad(lambda z: change(rebuild(z), kept, key_kept))(z)
            ascent, metrics = ascent - config.retention * found[1], metrics | {"change": found[0]}
        move, memory = optimizer.update(ascent, state.optimizer)
        lost, z = state.lost + lost, z + state.rate * move
        state = state.replace(parameters=z, optimizer=memory, key=key, lost=lost)
        return state, metrics | {"slope": jnp.linalg.norm(ascent)}

    return jax.lax.scan(step, state, length=steps)


def current(config: GradientConfig, start: Controller, state: GradientState) -> Controller:
    """The controller at the parameters that the ascent has reached."""
    return coordinates(start, config.searched)[-1](state.parameters)


def settled(state: GradientState, worth: float, tolerance: float) -> GradientState:
    """The state of which it has become known what it is worth; it may go back to its best."""
    now = Reached(state.parameters, state.optimizer, jnp.asarray(worth, state.worth.dtype))
    best, rate = state.best, state.rate
    if worth >= best.worth:
        best = now
    elif worth < best.worth - tolerance:
        now, rate = best, rate / 2
    return state.replace(
        parameters=now.parameters, optimizer=now.optimizer, worth=now.worth, best=best, rate=rate
    )


class Gradient(SearchStage):
    """The stage of training: the ascent; what is judged, by ``stage.value``, is where it is."""

    def __init__(self, config: GradientConfig, policy: Any, task: Task):
        """Raises ``JaxpendError`` as ``init``."""
        super().__init__(config, policy, task)
        if task.chance or not isinstance(task.scoring, ScoreV2):
            text = "the gradient climbs a smooth v2 score of the nominal plant"
            raise JaxpendError(f"{text}; this task has another score")
        if config.retention:
            _check_retention(policy)
            check_time(config.retained_after, task, "gradient")

    name, title, unit, column = "gradient", "Gradient", "steps", "step"
    heading, scores = "after the gradient", ("score",)
    charts = (
        Chart("Official score", {"best so far": "best", "now": "score"}, "score"),
        Chart("Smooth score", {"smooth score": "smooth_score"}, "of the nominal run"),
        Chart("Norm of the gradient", {"norm": "slope"}, log=True),
    )

    @classmethod
    def of(cls, run: Run, start: Controller | None, task: Task) -> Stage | None:
        config = getattr(run, "gradient", None)
        if not (config and config.steps):
            return None
        if isinstance(run, TrainRun):
            contestants = run.sac.contestants * (1 + run.openings.count)
            if contestants > 1:
                return Contest(config, start, task, contestants)
        return cls(config, start, task)

    def begin(self, seed: int, controller: Controller) -> SearchState:
        key = jax.random.fold_in(jax.random.key(seed), 2)
        search = init(self.config, controller, key, self.task)
        return SearchState(controller, search, jnp.asarray(0))

    def search(self, states: list[SearchState], count: int) -> list[tuple[GradientState, Row]]:
        chunk = partial(improve, self.config, steps=count, task=self.task)
        if self.config.scenarios:  # the nominal run alone has nothing to share
            chunk = partial(devices.compute, chunk)
        return [chunk(state.start, state.search) for state in states]

    def advance(self, states: list[SearchState]) -> list[tuple[SearchState, Row]]:
        known = [
            state if jnp.isfinite(state.search.best.worth) else self._settled(state)[0]
            for state in states  # before the first step nobody has asked what it is worth
        ]
        after = []
        for state, metrics in super().advance(known):
            state, row = self._settled(state)
            row |= {name: values[-1] for name, values in metrics.items()}
            after.append((state, row | {"rate": state.search.rate}))
        return after

    def _settled(self, state: SearchState) -> tuple[SearchState, Row]:
        score, worth = self.compared(current(self.config, state.start, state.search))
        row = {"score": score, "value": worth, "lost": int(state.search.lost)}
        search = settled(state.search, worth, self.config.tolerance)
        return state.replace(search=search), row

    def judge(self, state: SearchState, metrics: Row) -> tuple[Row, Candidates]:
        policy = current(self.config, state.start, state.search)
        if metrics:
            return metrics, [(policy, float(state.search.worth))]
        row = self._settled(state)[1]
        return row, [(policy, row["value"])]

    def note(self, row: Row) -> str:
        return f"smooth score {float(row['smooth_score']):.4f}  score {row['score']:.4f}"

    def watched(self, state: SearchState) -> jax.Array:
        return state.search.parameters


@pytree
class ContestState(Pytree):
    """The ascents of several controllers, and which of them go on."""

    each: tuple[SearchState, ...]
    worths: jax.Array  # (contestants,) the most that they have been worth; -inf: out


class Contest(Stage[tuple[Controller, ...], ContestState, Controller]):
    """The gradient from several controllers, of which half is left out again and again.

    Successive halving (Jamieson and Talwalkar, 2016): as an ascent stays in the basin in which
    it begins, a short one from each of several controllers says which basin is worth the rest.
    The last halving is in the middle of the stage.
    """

    name, title, unit, column = Gradient.name, Gradient.title, Gradient.unit, Gradient.column
    heading, scores, charts = Gradient.heading, Gradient.scores, Gradient.charts

    def __init__(self, config: GradientConfig, policy: Any, task: Task, contestants: int):
        self.inner, self.contestants = Gradient(config, policy, task), contestants
        self.config, self.policy, self.total = config, policy, config.steps
        self.objective, self.task = config.objective, task

    def start(self, seed: int, before: tuple[Controller, ...]) -> ContestState:
        each = tuple(self.inner.start(seed, controller) for controller in before)
        return ContestState(each, jnp.zeros(len(each)))

    def like(self) -> ContestState:
        return jax.eval_shape(partial(self.start, 0), (self.policy,) * self.contestants)

    def policy_like(self) -> Controller:
        return self.policy

    def done(self, state: ContestState) -> int:
        return max(self.inner.done(one) for one in state.each)

    def kept(self, done: int) -> int:
        """How many are in the contest after ``done`` steps."""
        halvings = math.ceil(math.log2(self.contestants))
        passed = sum(done >= self.total / 2**k for k in range(1, halvings + 1))
        return math.ceil(self.contestants / 2**passed)

    def advance(self, states: list[ContestState]) -> list[tuple[ContestState, Row]]:
        return [self._advanced(state) for state in states]

    def _advanced(self, state: ContestState) -> tuple[ContestState, Row]:
        each, worths, rows = list(state.each), np.full(len(state.each), -np.inf, "f4"), []
        for i in ranked(state.worths)[: self.kept(self.done(state))]:
            [(each[i], row)] = self.inner.advance([each[i]])
            worths[i] = each[i].search.best.worth
            rows.append(row)
        best = max(rows, key=lambda row: row["value"])
        row = best | {"contestants": len(rows), "lost": sum(row["lost"] for row in rows)}
        return ContestState(tuple(each), jnp.asarray(worths)), row

    def judge(self, state: ContestState, metrics: Row) -> tuple[Row, Candidates]:
        if not metrics:
            judged = [self.inner.judge(one, metrics) for one in state.each]
            candidates = [candidate for _, [candidate] in judged]
            return max((row for row, _ in judged), key=lambda row: row["value"]), candidates
        still = [state.each[i] for i in ranked(state.worths) if np.isfinite(state.worths[i])]
        return metrics, [self.inner.judge(one, metrics)[1][0] for one in still]

    def note(self, row: Row) -> str:
        return f"{row['contestants']} in the contest  {self.inner.note(row)}"

    def watched(self, state: ContestState) -> Any:
        return [self.inner.watched(one) for one in state.each]

    def rekey(self, state: ContestState, number: int) -> ContestState:
        return state.replace(each=tuple(self.inner.rekey(one, number) for one in state.each))


if __name__ == "__main__":
    from .cli.app import main

    main("gradient")

"""Many scenarios through the same rollout: outcomes, severity curves, maps, the worst case.

A sweep runs in chunks of a Python loop over one compiled program, so its size is bounded by
time and not by memory. Only final states leave it, and scores if asked for.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from . import devices
from .controller import Controller, check_controller
from .criteria import EPSILON, HEIGHT, Criteria, criteria, score_v2, upright
from .errors import JaxpendError
from .fields import Bounds, checked
from .plant import Plant
from .pytree import Pytree, check_constant, pytree
from .rollout import final_state, rollout
from .scenario import DT, DURATION, Scenario, check_values
from .variations import numbers, vary

__all__ = [
    "EPSILON", "Outcome", "Survey", "at_least_one", "compile_sweep", "mildest_failure", "survey",
    "sweep", "upright",
]  # fmt: skip

Ends = tuple[float, float]  # harmless, bad


@pytree
class Outcome(Pytree):
    """What became of n rollouts."""

    x: jax.Array  # (n, 4) final state
    success: jax.Array  # (n,) bool, upright at the end
    diverged: jax.Array  # (n,) bool, not a number: a failure
    score: jax.Array | None = None  # (n,) v2 score; 0 where its own rule of success is not met


@partial(jax.jit, static_argnames=("scoring", "height", "dt", "duration", "delay_slots"))
def _run(scenarios, controller, keys, *, scoring, height, duration, **options):
    """One chunk."""

    def one(controller, scenario, key):
        if scoring is None:
            return final_state(scenario, controller, key, duration=duration, **options), None
        run = rollout(scenario, controller, key, duration=duration, **options)
        c = criteria(run.t, run.x, run.u, scenario.plant, height=height, t_final=duration)
        return run.x[-1], scoring(c)

    every = jax.vmap(one, in_axes=(None, 0, 0))
    x, score = devices.split(every, controller)(scenarios, keys)
    return Outcome(x, upright(x), ~jnp.all(jnp.isfinite(x), axis=-1), score)


def _lean(scenarios: Scenario) -> Scenario:
    """Without Coulomb friction where no rollout has any: its arctan is a third of a step."""
    if scenarios.plant.coulomb_friction is None or np.any(scenarios.plant.coulomb_friction):
        return scenarios
    return scenarios.replace(plant=scenarios.plant.replace(coulomb_friction=None))


def _chunks(scenarios: Scenario, keys: jax.Array, size: int) -> Iterator[tuple]:
    """Equal pieces of at most ``size``, the last one filled up with copies of the last rollout."""
    n = len(keys)
    count = -(-n // size)
    for index in devices.pieces(n, -(-n // count)):
        yield jax.tree.map(lambda leaf, at=index: leaf[at], (scenarios, keys))


def _rows(scenarios: Scenario) -> int:
    """How many scenarios a batch holds. Raises ``JaxpendError`` for what is no batch."""
    if not isinstance(scenarios, Scenario) or np.ndim(scenarios.plant.mass) != 2:
        what = type(scenarios).__name__
        raise JaxpendError(f"{what} is no batch of scenarios; vary(Scenario(plant), ...) makes one")
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(scenarios)}
    if len(sizes) > 1:
        text = f"the parts of the batch have leading axes {sorted(sizes)}; they must be the same"
        raise JaxpendError(text)
    return len(scenarios.plant.mass)


def at_least_one(**counts: int) -> None:
    """Raise ``JaxpendError`` for a count below 1; it is known by its name."""
    for name, count in counts.items():
        checked(Annotated[int, Bounds(least=1)], count, name)


def _plan(
    scenarios, key, *, scored=False, scoring=score_v2, height=HEIGHT, dt=DT, duration=DURATION,
    chunk=None,
):  # fmt: skip
    """Pieces (scenarios, keys) for ``_run``, and its static arguments; options as in ``sweep``."""
    size = (512 if scored else 4096) if chunk is None else chunk
    at_least_one(chunk=size)
    # The buffer is as long as the longest delay needs.
    slots = scenarios.longest_delay + 1
    static = {"dt": dt, "duration": duration, "delay_slots": slots}
    static |= {"scoring": scoring, "height": height} if scored else {"scoring": None, "height": 0}
    keys = jax.random.split(key, _rows(scenarios))
    return _chunks(_lean(scenarios), keys, size), static


def sweep(
    scenarios: Scenario,
    controller: Controller,
    key: jax.Array,
    *,
    scored: bool = False,
    scoring: Callable[[Criteria], jax.Array] = score_v2,
    height: float = HEIGHT,
    dt: float = DT,
    duration: float = DURATION,
    chunk: int | None = None,
) -> Outcome:
    """Run one controller on a batch of scenarios.

    A rollout that diverges is a failure, flagged as diverged, and touches no other.

    Args:
        scenarios: every leaf with a leading axis of n, as ``vary`` makes them.
        controller: one for all.
        key: split once per rollout, whatever the chunk, so chunking changes nothing.
        scored: the performance score as well, which keeps a chunk of trajectories in memory.
        scoring, height: of that score, as in a ``Task``.
        dt, duration: s.
        chunk: rollouts at a time; by default 4096, or 512 when scored.

    Returns:
        The outcome with numpy arrays, n long.

    Raises:
        JaxpendError: what is no batch, values that mean nothing (see ``check_values``), what is
            no controller, or a chunk below 1.
    """
    n = _rows(scenarios)
    check_values(scenarios)
    check_controller(controller)
    pieces, static = _plan(
        scenarios, key, scored=scored, scoring=scoring, height=height, dt=dt, duration=duration,
        chunk=chunk,
    )  # fmt: skip
    outcomes = [devices.compute(_run, piece, controller, keys, **static) for piece, keys in pieces]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:n], *outcomes)


def compile_sweep(
    scenarios: Scenario, controller: Controller, key: jax.Array, **options: Any
) -> None:
    """Compile what ``sweep`` with the same arguments runs."""
    check_controller(controller)
    pieces, static = _plan(scenarios, key, **options)
    first, keys = next(pieces)
    with devices.together(controller):
        _run.lower(*devices.everywhere((first, controller, keys)), **static).compile()


def _varied(scenario, controller, changes, draw_key, run_key, options) -> Outcome:
    """A sweep over a scenario, or a plant, with changes to it."""
    scenario = Scenario(scenario) if isinstance(scenario, Plant) else scenario
    scenarios = vary(scenario, changes, key=draw_key, dt=options.get("dt", DT))
    return sweep(scenarios, controller, run_key, **options)


@dataclasses.dataclass(frozen=True)
class Survey:
    """Outcomes over a grid of imperfections: a curve for one name, a map for two."""

    values: dict[str, np.ndarray]  # name -> grid values, one axis each, in this order
    success: np.ndarray  # fraction of the repetitions
    diverged: np.ndarray  # number of the repetitions
    score: np.ndarray | None  # mean v2 score of the repetitions


def survey(
    scenario: Scenario | Plant,
    controller: Controller,
    grid: Mapping[str, Any],
    key: jax.Array,
    *,
    repetitions: int = 1,
    **options: Any,
) -> Survey:
    """Success (and score) over the product of the grid's values.

    Args:
        scenario: what holds apart from the grid, or a plant for the nominal one.
        controller: the one judged.
        grid: name in ``VARIATIONS`` to its values, SI units.
        key: for the scenarios' draws and the rollouts' noise.
        repetitions: rollouts of each grid point, with draws of their own.
        **options: of ``sweep``: scored, dt, duration, chunk.

    Raises:
        JaxpendError: as ``vary`` and ``sweep``, or fewer than one repetition.
    """
    at_least_one(repetitions=repetitions)
    if not grid:
        raise JaxpendError("the grid is empty; give at least one imperfection and its values")
    values = {name: numbers(name, given) for name, given in grid.items()}
    points = np.meshgrid(*values.values(), np.arange(repetitions), indexing="ij")[:-1]
    changes = {name: p.ravel() for name, p in zip(values, points, strict=True)}
    draw_key, run_key = jax.random.split(key)
    outcome = _varied(scenario, controller, changes, draw_key, run_key, options)
    shape, score = points[0].shape, outcome.score
    return Survey(
        values=values,
        success=np.mean(outcome.success.reshape(shape), axis=-1),
        diverged=np.sum(outcome.diverged.reshape(shape), axis=-1),
        score=None if score is None else np.mean(score.reshape(shape), axis=-1),
    )


def mildest_failure(
    scenario: Scenario | Plant,
    controller: Controller,
    ranges: Mapping[str, tuple[float, float]],
    key: jax.Array,
    *,
    samples: int = 1024,
    **options: Any,
) -> dict[str, Any]:
    """The worst case found: the least that has to go wrong for the controller to fail.

    Draws combinations of imperfections uniformly between nothing wrong and as bad as it gets,
    and of those that fail returns the one with the smallest severity: the largest, over the
    imperfections, of the fraction of the way to its bad end.

    Args:
        scenario, controller: as in ``survey``.
        ranges: name to (harmless value, bad value).
        key: for samples, draws and noise.
        samples: combinations tried.
        **options: of ``sweep``.

    Returns:
        ``failures`` (fraction of the samples), and if there are any ``severity`` in [0, 1] and
        ``values``, else None in their place.

    Raises:
        JaxpendError: as ``survey``, fewer than one sample, or a range that is not two numbers.
    """
    at_least_one(samples=samples)
    if not ranges:
        raise JaxpendError("there are no ranges; give at least one imperfection and its ends")
    place_key, draw_key, run_key = jax.random.split(key, 3)
    # A copy: a view of what jax holds cannot be written to.
    fraction = np.array(jax.random.uniform(place_key, (samples, len(ranges))), float)
    # Uniform in severity: else almost all samples of many imperfections would be bad in one.
    fraction *= np.linspace(0, 1, samples)[:, None] / fraction.max(axis=1, keepdims=True)
    for name, pair in ranges.items():
        check_constant(Ends, pair, f"the range of {name}")
    ends = np.array(list(ranges.values()), float)
    values = ends[:, 0] + fraction * (ends[:, 1] - ends[:, 0])
    changes = dict(zip(ranges, values.T, strict=True))
    outcome = _varied(scenario, controller, changes, draw_key, run_key, options)
    failed = np.flatnonzero(~outcome.success)
    if not len(failed):
        return {"failures": 0.0, "severity": None, "values": None}
    worst = failed[np.argmin(fraction[failed].max(axis=1))]
    return {
        "failures": len(failed) / samples,
        "severity": float(fraction[worst].max()),
        "values": {name: float(v[worst]) for name, v in changes.items()},
    }

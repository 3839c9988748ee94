"""The six-criterion robustness benchmark of the RealAIGym v2 boards.

722 runs of 10 s: 10 plant parameters x 21 values, velocity noise and torque noise 21 values x
10 repetitions, torque response and delay 21 values, 50 random series of disturbance pulses. A
run succeeds if its final state is upright (``sweep.EPSILON``); a grid value passes if more than
half of its repetitions do; a criterion scores the fraction of its values that pass; the overall
score is the mean of the six. It runs in float32 by default, which moves single runs at the
edge of failure and no more; ``precision="float64"`` is the reference's arithmetic.
"""

import concurrent.futures
import dataclasses
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .boards import CRITERIA, Board, Strip, board, strips
from .controller import Controller, check_robot
from .errors import JaxpendError, choose
from .plant import Plant
from .scenario import DT, Scenario, with_neutral
from .sweep import at_least_one, compile_sweep, survey, sweep
from .variations import INERTIAL, RANGES, VARIATIONS, vary

__all__ = [
    "CRITERIA", "KEYS", "Report", "Strip", "benchmark", "nominal_and_worst", "passes", "strips",
    "success_map",
]  # fmt: skip

KEYS = 3  # by default; with one key, runs at the edge of failure change the result by up to 0.03


@dataclasses.dataclass(frozen=True)
class Report:
    """What the benchmark found. Dicts go by criterion or, for grids, by the name of the grid.

    What is drawn is drawn for several keys; every score here is the median over them.
    """

    overall: float  # median over keys of the mean of the scores
    scores: dict[str, float]  # criterion -> fraction of its grid values that pass
    grids: dict[str, Strip]
    success: dict[str, np.ndarray]  # grid -> (values,) fraction of the repetitions, first key
    performance: dict[str, np.ndarray] | None  # grid -> (values,) mean v2 score, first key
    diverged: dict[str, int]  # criterion -> runs that diverged, first key
    overall_by_key: list[float]
    scores_by_key: dict[str, list[float]]  # of the criteria that draw something
    simulations: int  # of one key
    compile_seconds: float
    run_seconds: float  # of all keys

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and dicts: what the command writes as JSON."""
        by_key = np.array(self.overall_by_key)
        criteria: dict[str, Any] = {
            name: {"score": score, "diverged": self.diverged[name], "grids": {}}
            for name, score in self.scores.items()
        }
        for name, strip in self.grids.items():
            grid: dict[str, Any] = {"variation": strip.variation, "values": strip.values.tolist()}
            grid["success"] = self.success[name].tolist()
            if self.performance is not None:
                grid["performance"] = self.performance[name].tolist()
            criteria[strip.criterion]["grids"][name] = grid
        over_keys: dict[str, Any] = {"keys": len(by_key)}
        over_keys |= {how: float(getattr(by_key, how)()) for how in ("mean", "std", "min", "max")}
        over_keys |= {"overall": self.overall_by_key, "scores": self.scores_by_key}
        return {
            "overall": self.overall,
            "scores": self.scores,
            "over_keys": over_keys,
            "simulations": self.simulations,
            "diverged": sum(self.diverged.values()),
            "compile_seconds": self.compile_seconds,
            "run_seconds": self.run_seconds,
            "criteria": criteria,
        }


def passes(fraction: np.ndarray) -> np.ndarray:
    """Whether a grid value counts as mastered: more than half of its repetitions, strictly."""
    return np.asarray(fraction) > 0.5


def _base(nominal: Scenario, strips: Iterable[Strip]) -> Scenario:
    """The nominal scenario, with all that the strips vary in it at no strength.

    One program for all that draws something and one for all else: what the absent imperfections
    cost a run is little beside what six programs cost to compile.
    """
    varied = {VARIATIONS[strip.variation].field for strip in strips}
    return with_neutral(nominal, varied)


def _scenarios(base: Scenario, strips: Iterable[Strip], key: jax.Array, dt: float) -> Scenario:
    """One batch with every run of the strips, repetitions innermost."""
    batches = []
    for number, strip in enumerate(strips):
        changes = {strip.variation: np.repeat(strip.values, strip.repetitions)}
        batches.append(vary(base, changes, key=jax.random.fold_in(key, number), dt=dt))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *batches)


def _split(grids: Mapping[str, Strip], values: np.ndarray) -> dict[str, np.ndarray]:
    """Per grid, the mean over repetitions of what ``_scenarios`` lined up."""
    found, start = {}, 0
    for name, s in grids.items():
        n = len(s.values) * s.repetitions
        found[name] = values[start : start + n].reshape(-1, s.repetitions).mean(axis=1)
        start += n
    return found


def _compile(jobs: list[tuple], options: dict[str, Any]) -> float:
    """Compile all jobs, two at a time; seconds."""
    start, x64 = time.perf_counter(), jnp.result_type(float) == jnp.float64

    def one(job):
        with jax.enable_x64(x64):  # the setting belongs to a thread
            compile_sweep(*job, **options)

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        list(pool.map(one, jobs))
    return time.perf_counter() - start


def _named(grids: Iterable[Strip]) -> dict[str, Strip]:
    """The strips by the name of what they vary; of several, the later ones with a number."""
    named: dict[str, Strip] = {}
    for strip in grids:
        choose("variation", strip.variation, VARIATIONS)
        at_least_one(repetitions=strip.repetitions)
        count = sum(other.variation == strip.variation for other in named.values())
        name = f"{strip.variation} ({count + 1})" if count else strip.variation
        named[name] = dataclasses.replace(strip, values=np.atleast_1d(strip.values))
    if not named:
        raise JaxpendError("grids is empty; give at least one strip")
    return named


def benchmark(
    controller: Controller,
    judged_on: Board | str | Scenario | Plant,
    key: jax.Array,
    *,
    keys: int = KEYS,
    grids: Sequence[Strip] | None = None,
    **options: Any,
) -> Report:
    """Judge a controller.

    Args:
        controller: any controller; a ``PythonLaw`` for one that is not written in jax.
        judged_on: a board, "acrobot" or "pendubot" for the v2 board of that robot; or a nominal
            plant; or a scenario, with more that goes wrong in every run. The type of its numbers
            is the precision.
        key: split per key, criterion, scenario and run.
        keys: how often what draws something (noise, disturbances) is repeated; what is reported
            is the median.
        grids: other strips than the official ones, of any criteria and variations.
        **options: of ``sweep``; time grid and score are those of a board unless given here. The
            perturbations need 10 s.

    Raises:
        JaxpendError: fewer than one key, no strips, a controller of the other robot, or as
            ``sweep``.
    """
    at_least_one(keys=keys)
    trials: Callable[[Plant], list[Strip]] = strips
    if isinstance(judged_on, Board | str):
        official = board(judged_on)
        check_robot(controller, official.robot)
        if official.trials is None:
            raise JaxpendError(f"the {official.name} board has no robustness benchmark")
        task, trials = official.task, official.trials
        grid = {"dt": task.dt, "duration": task.duration}
        options = grid | {"scoring": task.scoring, "height": task.height} | options
        judged_on = task.plant
    nominal = Scenario(judged_on) if isinstance(judged_on, Plant) else judged_on
    named = _named(trials(nominal.plant) if grids is None else grids)
    rows: dict[bool, dict[str, Strip]] = {False: {}, True: {}}
    for name, strip in named.items():
        rows[VARIATIONS[strip.variation].draws][name] = strip
    jobs, dt = {}, options.get("dt", DT)
    for draws, its in rows.items():
        for number in range(keys if draws else 1) if its else ():
            draw_key, run_key = jax.random.split(jax.random.fold_in(key, number))
            scenarios = _scenarios(_base(nominal, its.values()), its.values(), draw_key, dt)
            jobs[draws, number] = (scenarios, controller, run_key)
    compile_seconds = _compile([job for (_, number), job in jobs.items() if number == 0], options)
    start = time.perf_counter()
    outcomes = {name: sweep(*job, **options) for name, job in jobs.items()}
    seconds = {"compile_seconds": compile_seconds, "run_seconds": time.perf_counter() - start}
    return _report(named, rows, outcomes, keys, **seconds)


def _report(named, rows, outcomes, keys, **seconds) -> Report:
    """Put together the outcomes, which go by (draws something, number of the key)."""

    def of_key(number: int, field: str) -> dict[str, np.ndarray]:
        found: dict[str, np.ndarray] = {}
        for draws, its in rows.items():
            if its:
                outcome = outcomes[draws, number if draws else 0]
                found |= _split(its, getattr(outcome, field))
        return found

    criteria: dict[str, list[str]] = {}
    for name, strip in named.items():
        criteria.setdefault(strip.criterion, []).append(name)

    def scores(success: dict[str, np.ndarray]) -> dict[str, float]:
        return {
            criterion: float(np.mean(passes(np.concatenate([success[n] for n in names]))))
            for criterion, names in criteria.items()
        }

    success = [of_key(number, "success") for number in range(keys)]
    by_key = [scores(s) for s in success]
    drawn = {named[name].criterion for name in rows[True]}
    lost, diverged = of_key(0, "diverged"), dict.fromkeys(criteria, 0)
    for name, strip in named.items():
        diverged[strip.criterion] += round(lost[name].sum() * strip.repetitions)
    scored = next(iter(outcomes.values())).score is not None
    overall = [float(np.mean(list(s.values()))) for s in by_key]
    return Report(
        overall=statistics.median(overall),
        scores={c: statistics.median([s[c] for s in by_key]) for c in criteria},
        grids=named,
        success=success[0],
        performance=of_key(0, "score") if scored else None,
        diverged=diverged,
        overall_by_key=overall,
        scores_by_key={c: [s[c] for s in by_key] for c in criteria if c in drawn},
        simulations=sum(len(s.values) * s.repetitions for s in named.values()),
        **seconds,
    )


def nominal_and_worst(plant: Plant) -> dict[str, tuple[float, float]]:
    """For ``--worst``: from nothing wrong to the worst end of the official grids."""
    names = ("b1", "b2", "cf1", "cf2", "Ir", "delay", "velocity_noise", "torque_noise")
    m2 = float(plant.mass[1])
    rising = {name: (0.0, RANGES[name][1]) for name in names}
    return rising | {"m2": (m2, INERTIAL[1] * m2), "responsiveness": (1.0, 0.1)}


def success_map(controller, plant, names, key, options) -> dict[str, Any]:
    """Success over the official values of two imperfections."""
    grids = {s.variation: s for s in strips(plant) if s.variation != "perturbation"}
    axes = {name: grids[choose("imperfection with a grid", name, grids)] for name in names}
    repetitions = max(strip.repetitions for strip in axes.values())
    values = {name: strip.values for name, strip in axes.items()}
    if len(values) != 2:
        raise JaxpendError(f"a map needs two different imperfections; got {names[0]} twice")
    found = survey(plant, controller, values, key, repetitions=repetitions, **options)
    return {"values": values, "success": found.success, "performance": found.score}


if __name__ == "__main__":
    from .cli.app import main

    main("robustness")

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
import time
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from .controller import Controller
from .errors import JaxpendError, choose
from .plant import Plant
from .scenario import Pulses, Scenario
from .sweep import compile_sweep, survey, sweep
from .variations import vary

__all__ = ["CRITERIA", "Report", "Strip", "benchmark", "passes", "strips"]

# The six criteria in the order of the boards, and their headings there.
CRITERIA = {
    "model": "Model",
    "velocity_noise": "Velocity noise",
    "torque_noise": "Torque noise",
    "responsiveness": "Torque step response",
    "delay": "Time delay",
    "perturbation": "Perturbations",
}
# Those that draw something: repeated for every key.
RANDOM = ("velocity_noise", "torque_noise", "perturbation")


@dataclasses.dataclass(frozen=True)
class Strip:
    """One row of grid values of one criterion."""

    criterion: str
    variation: str  # name in ``VARIATIONS``
    values: np.ndarray  # (n,) SI units
    repetitions: int = 1


def strips(plant: Plant) -> list[Strip]:
    """The official grids around a nominal plant: 15 strips, 722 runs."""
    nominal = {name: np.asarray(value, float) for name, value in vars(plant).items()}
    m, r, inertia = nominal["mass"], nominal["com"], nominal["inertia"]
    scale, damping = np.linspace(0.75, 1.25, 21), np.linspace(-0.1, 0.1, 21)
    friction = np.linspace(-0.2, 0.2, 21)
    model = {
        "Ir": np.linspace(0, 1e-4, 21),
        "m1r1": scale * (m[0] * r[0]), "I1": scale * inertia[0], "b1": damping, "cf1": friction,
        "m2r2": scale * (m[1] * r[1]), "m2": scale * m[1], "I2": scale * inertia[1],
        "b2": damping, "cf2": friction,
    }  # fmt: skip
    return [
        *(Strip("model", name, values) for name, values in model.items()),
        Strip("velocity_noise", "velocity_noise", np.linspace(0, 0.5, 21), 10),
        Strip("torque_noise", "torque_noise", np.linspace(0, 1.1, 21), 10),
        Strip("responsiveness", "responsiveness", np.linspace(0.1, 2, 21)),
        Strip("delay", "delay", np.linspace(0, 0.04, 21)),
        Strip("perturbation", "perturbation", np.ones(50)),
    ]


@dataclasses.dataclass(frozen=True)
class Report:
    """What the benchmark found. Dicts go by criterion or, for grids, by variation."""

    overall: float  # mean of the scores
    scores: dict[str, float]  # criterion -> fraction of its grid values that pass
    grids: list[Strip]
    success: dict[str, np.ndarray]  # variation -> (values,) fraction of the repetitions
    performance: dict[str, np.ndarray] | None  # variation -> (values,) mean v2 score
    diverged: dict[str, int]  # criterion -> runs that diverged
    overall_by_key: list[float]  # the first one is ``overall``
    scores_by_key: dict[str, list[float]]  # of the criteria that draw something
    simulations: int  # of one benchmark
    compile_seconds: float
    run_seconds: float  # of all keys

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and dicts: what the command writes as JSON."""
        by_key = np.array(self.overall_by_key)
        criteria = {
            name: {"score": score, "diverged": self.diverged[name], "grids": {}}
            for name, score in self.scores.items()
        }
        for strip in self.grids:
            grid = {"values": strip.values.tolist()}
            grid["success"] = self.success[strip.variation].tolist()
            if self.performance is not None:
                grid["performance"] = self.performance[strip.variation].tolist()
            criteria[strip.criterion]["grids"][strip.variation] = grid
        summary = {
            "mean": by_key.mean(),
            "std": by_key.std(),
            "min": min(by_key),
            "max": max(by_key),
        }
        over_keys = {name: float(value) for name, value in summary.items()}
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


def _base(nominal: Scenario, draws: bool) -> Scenario:
    """The nominal scenario, with all that criteria of one kind vary in it at no strength.

    One program for all criteria that draw something and one for all others: what the absent
    imperfections cost a run is little beside what six programs cost to compile.
    """
    numbers = lambda value, *shape: np.full(shape, value, nominal.dtype)  # noqa: E731
    neutral = {"delay": np.zeros(4, "i4"), "responsiveness": numbers(1)}
    if draws:
        silent = Pulses(numbers(0, 2, 3), numbers(1, 2, 3), numbers(0, 2, 3))
        neutral = {"measurement_noise": numbers(0, 4), "torque_noise": numbers(0, 2)}
        neutral |= {"pulses": silent}
    absent = {name: v for name, v in neutral.items() if getattr(nominal, name) is None}
    return nominal.replace(**absent)


def _scenarios(base: Scenario, grids: Iterable[Strip], key: jax.Array, dt: float) -> Scenario:
    """One batch with every run of the strips, repetitions innermost."""
    batches = [
        vary(
            base,
            {s.variation: np.repeat(s.values, s.repetitions)},
            key=jax.random.fold_in(key, number),
            dt=dt,
        )
        for number, s in enumerate(grids)
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts), *batches)


def _split(grids: Iterable[Strip], values: np.ndarray) -> dict[str, np.ndarray]:
    """Per variation, the mean over repetitions of what ``_scenarios`` lined up."""
    found, start = {}, 0
    for s in grids:
        n = len(s.values) * s.repetitions
        found[s.variation] = values[start : start + n].reshape(-1, s.repetitions).mean(axis=1)
        start += n
    return found


def _compile(jobs: list[tuple], options: dict[str, Any]) -> float:
    """Compile all jobs, two at a time; seconds."""
    start, x64 = time.perf_counter(), jax.config.jax_enable_x64

    def one(job):
        with jax.enable_x64(x64):  # the setting belongs to a thread
            compile_sweep(*job, **options)

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        list(pool.map(one, jobs))
    return time.perf_counter() - start


def benchmark(
    controller: Controller,
    scenario: Scenario | Plant,
    key: jax.Array,
    *,
    keys: int = 1,
    scored: bool = False,
    dt: float = 0.002,
    duration: float = 10.0,
    chunk: int | None = None,
    grids: list[Strip] | None = None,
) -> Report:
    """Judge a controller. What is reported is the first key's; the others give the spread.

    Args:
        controller: any controller; a ``PythonLaw`` for one that is not written in jax.
        scenario: the nominal plant, such as ``designs.competition(robot)``, or a scenario with
            more that goes wrong in every run; its type is the precision.
        key: split per key, criterion, scenario and run.
        keys: how often the criteria that draw something (noise, disturbances) are repeated.
        scored: the mean v2 performance score at every grid value too.
        dt, duration: s; the perturbations need 10 s.
        chunk: of ``sweep``.
        grids: other strips than the official ones.

    Raises:
        JaxpendError: fewer than one key, or as ``sweep``.
    """
    if keys < 1:
        raise JaxpendError(f"keys is {keys}; it must be at least 1")
    nominal = Scenario(scenario) if isinstance(scenario, Plant) else scenario
    grids = strips(nominal.plant) if grids is None else grids
    options = {"scored": scored, "dt": dt, "duration": duration, "chunk": chunk}
    jobs = {}
    for draws in (False, True):
        rows = [s for s in grids if (s.criterion in RANDOM) == draws]
        for number in range(keys if draws else 1) if rows else ():
            draw_key, run_key = jax.random.split(jax.random.fold_in(key, number))
            scenarios = _scenarios(_base(nominal, draws), rows, draw_key, dt)
            jobs[draws, number] = (scenarios, controller, run_key)
    compile_seconds = _compile([job for (_, number), job in jobs.items() if number == 0], options)
    start = time.perf_counter()
    outcomes = {name: sweep(*job, **options) for name, job in jobs.items()}
    return _report(grids, outcomes, keys, compile_seconds, time.perf_counter() - start)


def _report(grids, outcomes, keys, compile_seconds, run_seconds) -> Report:
    """Put together the outcomes, which go by (draws something, number of the key)."""
    rows = {kind: [s for s in grids if (s.criterion in RANDOM) == kind] for kind, _ in outcomes}

    def of_key(number: int, field: str) -> dict[str, np.ndarray]:
        found = {}
        for draws in rows:
            outcome = outcomes[draws, number if draws else 0]
            found |= _split(rows[draws], getattr(outcome, field))
        return found

    def scores(success: dict[str, np.ndarray]) -> dict[str, float]:
        of = {c: [success[s.variation] for s in grids if s.criterion == c] for c in CRITERIA}
        return {c: float(np.mean(passes(np.concatenate(f)))) for c, f in of.items() if f}

    success = [of_key(number, "success") for number in range(keys)]
    by_key = [scores(s) for s in success]
    diverged = dict.fromkeys(by_key[0], 0)
    for s in grids:
        diverged[s.criterion] += round(of_key(0, "diverged")[s.variation].sum() * s.repetitions)
    scored = next(iter(outcomes.values())).score is not None
    overall = [float(np.mean(list(s.values()))) for s in by_key]
    return Report(
        overall=overall[0],
        scores=by_key[0],
        grids=grids,
        success=success[0],
        performance=of_key(0, "score") if scored else None,
        diverged=diverged,
        overall_by_key=overall,
        scores_by_key={c: [s[c] for s in by_key] for c in by_key[0] if c in RANDOM},
        simulations=sum(len(s.values) * s.repetitions for s in grids),
        compile_seconds=compile_seconds,
        run_seconds=run_seconds,
    )


# --- for the command ---------------------------------------------------------------------------


def nominal_and_worst(plant: Plant) -> dict[str, tuple[float, float]]:
    """For ``--worst``: from nothing wrong to the worst end of the official grids."""
    grids = {s.variation: s.values for s in strips(plant)}
    rising = {name: (0.0, grids[name][-1]) for name in ("b1", "b2", "cf1", "cf2", "Ir", "delay")}
    rising |= {name: (0.0, grids[name][-1]) for name in ("velocity_noise", "torque_noise")}
    return rising | {"m2": (grids["m2"][10], grids["m2"][-1]), "responsiveness": (1.0, 0.1)}


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

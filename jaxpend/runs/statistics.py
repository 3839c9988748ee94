"""Numbers over seeds: the interquartile mean, how far it may be off, and the summary of runs."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["interquartile_mean", "interval", "summary"]


def interquartile_mean(values: ArrayLike) -> np.ndarray:
    """Mean of the middle half of the seeds, which come first: (seeds, ...) -> (...).

    Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021.
    """
    from scipy.stats import trim_mean

    return trim_mean(np.asarray(values, float), 0.25, axis=0)


def interval(values: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Ends (...) of the 95 % percentile bootstrap interval of the interquartile mean over seeds.

    ``values`` are (seeds, ...); the seeds are drawn again together, whatever follows, 2,000 times.
    """
    values = np.asarray(values, float)
    rows = np.random.default_rng(0).integers(len(values), size=(2000, len(values)))
    low, high = np.quantile(interquartile_mean(values[rows].swapaxes(0, 1)), (0.025, 0.975), axis=0)
    return low, high


def summary(results: Sequence[Mapping[str, Any]], headings: Mapping[str, str]) -> dict[str, Any]:
    """Results of the seeds of one robot as one: the scores and their statistics, a stage each.

    ``headings`` are of the parts of a result, by name. ``interval`` is that of the interquartile
    mean; there is none of one seed.
    """
    stages = {}
    for name, heading in headings.items():
        if not all(name in result for result in results):
            continue
        scores = [result[name]["score"] for result in results]
        stages[name] = {
            "heading": heading,
            "scores": scores,
            "median": float(np.median(scores)),
            "interquartile_mean": float(interquartile_mean(scores)),
            "interval": np.array(interval(scores)).tolist() if len(scores) > 1 else None,
            "lowest": min(scores),
            "highest": max(scores),
        }
    seeds = [result["seed"] for result in results]
    return {"robot": results[0]["robot"], "seeds": seeds, "stages": stages}

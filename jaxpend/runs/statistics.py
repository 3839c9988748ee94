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


def interval(
    values: ArrayLike, level: float = 0.95, resamples: int = 2000, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Percentile bootstrap interval of the interquartile mean over seeds.

    Args:
        values: (seeds, ...); the seeds are drawn again together, whatever follows.
        level: of confidence.
        resamples: drawn with replacement, by numpy's generator from ``seed``.

    Returns:
        Lower and upper ends, each (...).
    """
    values = np.asarray(values, float)
    rows = np.random.default_rng(seed).integers(len(values), size=(resamples, len(values)))
    means = interquartile_mean(np.moveaxis(values[rows], 1, 0))
    tail = (1 - level) / 2
    return np.quantile(means, tail, axis=0), np.quantile(means, 1 - tail, axis=0)


def _aggregate(scores: Sequence[float]) -> dict[str, Any]:
    """The numbers of one stage; there is no interval of one seed."""
    return {
        "scores": list(scores),
        "median": float(np.median(scores)),
        "interquartile_mean": float(interquartile_mean(scores)),
        "interval": np.array(interval(scores)).tolist() if len(scores) > 1 else None,
        "lowest": min(scores),
        "highest": max(scores),
    }


def summary(results: Sequence[Mapping[str, Any]], headings: Mapping[str, str]) -> dict[str, Any]:
    """Results of the seeds of one robot as one: the scores and their statistics, a stage each.

    ``headings`` are of the parts of a result, by name. ``interval`` is the 95 % bootstrap interval
    of the interquartile mean.
    """
    return {
        "robot": results[0]["robot"],
        "seeds": [result["seed"] for result in results],
        "stages": {
            name: {"heading": heading} | _aggregate([result[name]["score"] for result in results])
            for name, heading in headings.items()
            if all(name in result for result in results)
        },
    }

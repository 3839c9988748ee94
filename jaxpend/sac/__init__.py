"""Soft actor-critic: networks, demonstrations and the algorithm, all on device."""

from ..config import SACConfig
from .algorithm import (
    SACState,
    begin,
    greedy_policy,
    imitate_chunk,
    init,
    structure,
    train_chunk,
    train_chunks,
)

__all__ = [
    "SACConfig",
    "SACState",
    "begin",
    "greedy_policy",
    "imitate_chunk",
    "init",
    "structure",
    "train_chunk",
    "train_chunks",
]

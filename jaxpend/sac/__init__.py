"""Soft actor-critic: networks, critics, replay, demonstrations and the algorithm, on device."""

from ..config import SACConfig
from .algorithm import (
    Agent,
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
    "Agent",
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

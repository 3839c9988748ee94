"""Soft actor-critic: networks, critics, replay, demonstrations and the algorithm, on device."""

from ..config import SACConfig
from .algorithm import Agent, SACState, greedy_policy, init, train_chunk, train_chunks

__all__ = ["Agent", "SACConfig", "SACState", "greedy_policy", "init", "train_chunk", "train_chunks"]

"""The loop that takes runs through the stages of training."""

from .loop import execute, train

__all__ = ["execute", "train"]

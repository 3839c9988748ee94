"""The loop that takes runs through the stages of training."""

from .loop import train

__all__ = ["train"]

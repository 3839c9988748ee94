"""The command line."""

from .app import COMMANDS, Command, function_of, main, one_sentence, run
from .cache import compile_cache
from .options import parse
from .output import emit_json

__all__ = [
    "COMMANDS", "Command", "compile_cache", "emit_json", "function_of", "main", "one_sentence",
    "parse", "run",
]  # fmt: skip

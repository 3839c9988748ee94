"""The command line."""

from .app import COMMANDS, Command, compile_cache, emit_json, guard, main, parse, run

__all__ = ["COMMANDS", "Command", "compile_cache", "emit_json", "guard", "main", "parse", "run"]

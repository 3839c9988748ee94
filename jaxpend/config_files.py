"""Configurations in files and as plain mappings, without jax."""

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from .errors import JaxpendError
from .fields import checked, hints_of

__all__ = ["flat", "from_mapping", "load_config", "read_yaml", "recipes", "to_mapping"]

T = TypeVar("T")


def to_mapping(config: Any) -> dict:
    """A configuration dataclass as plain nested dicts and lists, as YAML and JSON have them.

    Infinities become text, since JSON has no number for them; ``from_mapping`` reads it back.
    """
    return json.loads(json.dumps(dataclasses.asdict(config)), parse_constant=str)


def from_mapping(default: T, values: Any, where: str, section: str = "") -> T:
    """``default`` with the fields named in a nested mapping replaced.

    Numbers may be written as text: YAML takes 1e-3 for one, and ``to_mapping`` infinities.

    Args:
        default: a configuration; sections of it are configurations too.
        values: field -> value, or section -> such a mapping.
        where: the source, which sentences name first; may be empty.
        section: what they have before the name of a field, such as "sac.".

    Raises:
        JaxpendError: an unknown field, or a value that does not fit it.
    """
    known, prefix = hints_of(type(default)), f"{where}: {section}" if where else section
    if not isinstance(values, dict):
        what = f"{prefix.rstrip('.: ')} must hold fields of {type(default).__name__}"
        raise JaxpendError(f"{what}: {', '.join(known)}")
    changes = {}
    for name, value in values.items():
        if name not in known:
            raise JaxpendError(f"{prefix}{name} is unknown; known: {', '.join(known)}")
        old = getattr(default, name)
        if dataclasses.is_dataclass(old):
            changes[name] = from_mapping(old, value, where, f"{section}{name}.")
        else:
            changes[name] = checked(known[name], value, f"{prefix}{name}", text=True)
    try:
        return dataclasses.replace(default, **changes)  # type: ignore[type-var]
    except JaxpendError as error:  # fields that do not fit together
        raise JaxpendError(f"{prefix}{error}") from None


def recipes() -> list[str]:
    """Names of the configuration files that ship with the package."""
    folder = resources.files("jaxpend").joinpath("recipes")
    return sorted(f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith("yaml"))


def load_config(default: T, path: str | Path, also: Sequence[str] = ()) -> T:
    """``default`` with what a YAML file says; sections in ``also`` may be there without a field.

    ``path`` may be the name of a recipe that ships with the package (``recipes``).

    Raises:
        JaxpendError: the file cannot be read, or names an unknown field or a bad value.
    """
    file: Any = Path(path)
    if str(path) in recipes():
        file = resources.files("jaxpend").joinpath(f"recipes/{path}.yaml")
    elif not os.path.exists(path):
        known = ", ".join(recipes())
        raise JaxpendError(f"there is no configuration file {path}, and no such recipe: {known}")
    values = read_yaml(file)
    values = {} if values is None else values
    if isinstance(values, dict):
        values = {k: v for k, v in values.items() if k not in also or hasattr(default, k)}
    return from_mapping(default, values, str(path))


def read_yaml(path: Any) -> Any:
    """What a YAML (or JSON) file holds. Raises ``JaxpendError`` if it cannot be read."""
    import yaml  # only users with files of their own pay for it

    try:
        if isinstance(path, Path) and path.is_char_device():  # /dev/zero has no end
            raise ValueError
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise JaxpendError(f"cannot read {path}: {error.strerror or error}") from None
    except RecursionError:
        raise JaxpendError(f"{path} is nested too deeply, or holds itself") from None
    except Exception as error:  # the parser has many: for tags, dates, characters, long numbers
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        raise JaxpendError(f"{path} is not valid YAML{line}") from None


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Fields of nested mappings, dotted, with their values."""
    fields: dict[str, Any] = {}
    for name, value in values.items():
        deeper = isinstance(value, Mapping)
        fields |= flat(value, f"{prefix}{name}.") if deeper else {prefix + name: value}
    return fields

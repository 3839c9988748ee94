"""Which values a field may have: said once, in its type, and checked by one function.

    @dataclasses.dataclass(frozen=True)
    class Example(Checked):
        share: Share = 0.5
        layers: tuple[Count, ...] = (64, 64)
        clip: Annotated[float, Bounds(above=0, below=10)] = 1.0

Parameters of commands are declared in the same way, so that an option, a field of a file and an
argument in Python are refused with the same sentence.
"""

import dataclasses
import functools
import math
import numbers
import reprlib
import types
import typing
from pathlib import Path
from typing import Annotated, Any, Literal

from .errors import JaxpendError

__all__ = [
    "LARGEST", "OFF", "ON", "SLOWEST", "BoardName", "Bounds", "Checked", "Count", "Duration",
    "Natural", "NotNegative", "Period", "Positive", "PositiveOrInfinite", "Preset", "Rate", "Robot",
    "Scale", "Seed", "Share", "checked", "described", "hints_of", "split",
]  # fmt: skip

LARGEST = 2**31 - 1  # of an integer: what is counted on a device is counted in 32 bits
OFF = ("off", "no", "false", "0")
ON = ("on", "yes", "true", "1")


@dataclasses.dataclass(frozen=True)
class Bounds:
    """What a number must keep to; without ``infinite`` it must be finite, whatever the bounds."""

    above: float = -math.inf
    least: float = -math.inf
    below: float = math.inf
    most: float = math.inf
    infinite: bool = False

    def missed(self, value: float) -> str:
        """What the number must do, for one that does not; empty for one that does."""
        if not (value > self.above or self.above == -math.inf):
            return "be positive" if self.above == 0 else f"be above {self.above:,.12g}"
        if not (value >= self.least or self.least == -math.inf):
            return "not be negative" if self.least == 0 else f"be at least {self.least:,.12g}"
        if not (value < self.below or self.below == math.inf):
            return f"be below {self.below:,.12g}"
        if not (value <= self.most or self.most == math.inf):
            return f"be at most {self.most:,.12g}"
        if math.isnan(value):
            return "be a number"
        return "be finite" if math.isinf(value) and not self.infinite else ""


Count = Annotated[int, Bounds(above=0)]
Natural = Annotated[int, Bounds(least=0)]
Positive = Annotated[float, Bounds(above=0)]
PositiveOrInfinite = Annotated[float, Bounds(above=0, infinite=True)]
NotNegative = Annotated[float, Bounds(least=0)]
# Of what is multiplied with float32 numbers, which would be infinite or 0 where it is beyond them.
Scale = Annotated[float, Bounds(above=0, least=1e-9, most=1e9)]
SLOWEST = 1.0  # s, the longest control period of a policy
Period = Annotated[float, Bounds(above=0, most=SLOWEST)]
Duration = Annotated[float, Bounds(least=0.01, most=3600)]  # s
Share = Annotated[float, Bounds(least=0, most=1)]
Rate = Annotated[float, Bounds(above=0, most=1)]
# Keys of jax are made of 32 bits; the largest seed is for scenarios that no run trains on.
Seed = Annotated[int, Bounds(least=0, below=LARGEST)]
Robot = Literal["acrobot", "pendubot"]
Preset = Literal["identified", "wide", "compensated", "authors"]  # of ``hardware.PRESETS``
BoardName = Literal["v2", "v3", "hardware"]


class Checked:
    """Base of the configurations: a frozen dataclass whose fields are checked when it is made.

    Lists become tuples and numbers Python's own, so that a configuration is hashable and can be
    written to a file. Raises ``JaxpendError`` for the first field that does not fit its type.
    """

    def __post_init__(self) -> None:
        hints = hints_of(type(self))
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = checked(hints[field.name], getattr(self, field.name), field.name)
            object.__setattr__(self, field.name, value)


def hints_of(owner: Any) -> dict[str, Any]:
    """Name -> type of the fields of a class or the parameters of a function, bounds included."""
    return _hints_of(owner)


@functools.cache
def _hints_of(owner: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(owner, include_extras=True)
    if dataclasses.is_dataclass(owner):
        return {field.name: hints[field.name] for field in dataclasses.fields(owner)}
    return {name: hint for name, hint in hints.items() if name != "return"}


class _Unfit(Exception):
    """A value, and what it must do."""


def checked(hint: Any, value: Any, name: str, *, text: bool = False) -> Any:
    """``value`` as the type of a field has it; with ``text`` numbers and flags may be text.

    Raises:
        JaxpendError: it does not fit; ``name`` is what the sentence begins with.
    """
    try:
        return _fitted(hint, value, text)
    except _Unfit as unfit:
        shown, must = unfit.args
        if text and shown and isinstance(shown, list) and all(type(v) is str for v in shown):
            shown = " ".join(shown)
        raise JaxpendError(f"{name} is {reprlib.repr(shown)}; it must {must}") from None


def split(hint: Any) -> tuple[Any, Bounds, bool]:
    """A type without its bounds and without None; its bounds; whether it may be None."""
    bounds = next((b for b in getattr(hint, "__metadata__", ()) if isinstance(b, Bounds)), Bounds())
    if typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return hint, bounds, False
    inner = next(part for part in typing.get_args(hint) if part is not type(None))
    return *split(inner)[:2], True


def _fitted(hint: Any, value: Any, text: bool) -> Any:
    kind, bounds, optional = split(hint)
    if optional and (value is None or (text and value in ("None", ["None"]))):
        return None
    if typing.get_origin(kind) is tuple:
        return _fitted_tuple(kind, value, text)
    if typing.get_origin(kind) is Literal:
        if not (isinstance(value, str) and value in typing.get_args(kind)):
            raise _Unfit(value, f"be {described(kind)}")
        return value
    given = value
    if value == "" and (optional or kind is Path):
        raise _Unfit(value, "not be empty")
    if text and isinstance(value, str):
        value = _from_text(kind, value)
    if kind in (int, float):
        return _fitted_number(kind, bounds, value, given)
    if not isinstance(value, kind):
        raise _Unfit(given, f"be {described(kind)}")
    if kind is str and "\0" in value:
        raise _Unfit(value, "hold no null character")
    return value


def _fitted_number(kind: Any, bounds: Bounds, value: Any, given: Any) -> int | float:
    fits: type = numbers.Integral if kind is int else numbers.Real
    if isinstance(value, bool) or not isinstance(value, fits):
        raise _Unfit(given, f"be {described(kind)}")
    try:
        number = kind(value)
    except OverflowError:
        raise _Unfit(value, "be finite") from None
    if kind is int and abs(number) > LARGEST:
        raise _Unfit(number, f"be from {-LARGEST:,} to {LARGEST:,}")
    if missed := bounds.missed(number):
        raise _Unfit(number, missed)
    return number


def _fitted_tuple(kind: Any, value: Any, text: bool) -> tuple:
    inner = typing.get_args(kind)
    if not isinstance(value, list | tuple) or not value:
        raise _Unfit(value, f"be {described(kind)}")
    kinds = inner if inner[-1] is not ... else inner[:1] * len(value)
    if len(kinds) != len(value):
        raise _Unfit(value, f"be {described(kind)}")
    try:
        return tuple(_fitted(k, v, text) for k, v in zip(kinds, value, strict=True))
    except _Unfit as unfit:
        many = "one or more" if inner[-1] is ... else str(len(inner))
        raise _Unfit(value, f"be {many} values, each of which must {unfit.args[1]}") from None


def _from_text(kind: Any, value: str) -> Any:
    """A number or a flag that is written as text; other text as it is."""
    if kind is bool:
        return {**dict.fromkeys(ON, True), **dict.fromkeys(OFF, False)}.get(value.lower(), value)
    if kind not in (int, float, Path):
        return value
    try:
        return kind(value)
    except ValueError:
        return value


def described(hint: Any) -> str:
    """What a value of a type is, in words."""
    kind = split(hint)[0]
    inner = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return " or ".join(filter(None, (", ".join(inner[:-1]), inner[-1])))
    if typing.get_origin(kind) is tuple:
        many = "one or more" if inner[-1] is ... else str(len(inner))
        return f"{many} values, each {described(inner[0])}"
    words = {int: "an integer", float: "a number", Path: "a path", bool: "yes or no"}
    return words.get(kind) or ("a text" if kind is str else f"fields of {kind.__name__}")

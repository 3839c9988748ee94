"""How a C header computes with real numbers: as double, as float, or as pairs of floats."""

import dataclasses
import re
from collections.abc import Mapping

import numpy as np

from . import pairs
from .pairs import halves, text

__all__ = ["ARITHMETIC", "Arithmetic", "work"]


@dataclasses.dataclass(frozen=True)
class Arithmetic:
    """How the numbers of a program are written; {p} is the prefix of the header's names."""

    traced: str  # precision of the program
    given: str  # type of what goes in and comes out
    real: str  # type of what is computed with
    width: int  # bytes of that
    forms: Mapping[str, str]  # of operations whose first argument is a number
    helpers: Mapping[str, str]  # C functions by the end of their names, after those they call
    functions: Mapping[str, str]  # of the C library, by the operations that call them
    wide: str = "{0}"  # a number from outside, or of a table of floats, as one to compute with
    narrow: str = "{0}"  # and back
    zero: str = "0"
    # A sum with the product of a number and an entry of a table of floats, and the sum afterwards.
    plus: str = "{0} + {1} * {2}"
    summed: str | None = None

    @property
    def paired(self) -> bool:
        """Whether a number is a pair."""
        return self.wide != "{0}"

    def literal(self, value: np.ndarray) -> str:
        """A number, in an expression."""
        return f"{{p}}_pair({', '.join(halves(value))})" if self.paired else text(value)

    def entry(self, value: np.ndarray, exact: bool) -> str:
        """The same in a table, which is one of floats if it is ``exact``."""
        if not self.paired or exact:
            return halves(value)[0] if self.paired else text(value)
        return f"{{{', '.join(halves(value))}}}"

    def exact(self, table: np.ndarray) -> bool:
        """Whether floats are all that a table needs."""
        with np.errstate(over="ignore"):
            return self.paired and bool((table.astype("f4") == table).all())


def work(code: str, helpers: Mapping[str, str]) -> int:
    """Operators in a piece of C and in the helpers that it calls, at most."""
    found = len(re.findall(r" (?:[-+*/]=?|[<>?]|<=|>=|==|!=|&&|\|\|) ", code))
    called = re.findall(r"\{p\}(_\w+)\(", code)
    bodies = {name: text.partition("{\n")[2] for name, text in helpers.items()}
    return found + sum(work(bodies[name], helpers) for name in called if name in bodies)


# --- float and double --------------------------------------------------------------------------

_FORMS = {
    "add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "div": "{0} / {1}",
    "rem": "{p}_rem({0}, {1})", "neg": "-{0}", "abs": "{0} < 0 ? -{0} : {0}",
    "sign": "{0} != {0} ? {0} : (REAL)(({0} > 0) - ({0} < 0))",
    "max": "({0} > {1} || {0} != {0}) ? {0} : {1}", "min": "({0} < {1} || {0} != {0}) ? {0} : {1}",
    "floor": "{p}_floor({0})", "ceil": "-{p}_floor(-{0})", "round": "{p}_round({0})",
    "finite": "{0} - {0} == 0", "lt": "{0} < {1}", "le": "{0} <= {1}", "gt": "{0} > {1}",
    "ge": "{0} >= {1}", "eq": "{0} == {1}", "ne": "{0} != {1}", "int": "{p}_int({0})",
    "bool": "{0} != 0", "from int": "(REAL){0}",
    # Where the first argument cannot be NaN.
    "sure max": "{0} > {1} ? {0} : {1}", "sure min": "{0} < {1} ? {0} : {1}",
}  # fmt: skip
_FUNCTIONS = ("sqrt", "exp", "log", "sin", "cos", "tanh", "atan")
_FLOOR = """
    static inline REAL {p}_floor(REAL a)
    {
        if (!(a < WHOLEf && a > -WHOLEf)) return a;
        const REAL n = (REAL)(int)a;
        return n > a ? n - 1.0f : n;
    }
"""
_HELPERS = {
    "_int": """
        /* Towards zero, at most what an int holds; 0 of NaN. */
        static inline int {p}_int(REAL a)
        {
            if (a != a) return 0;
            if (a >= 2147483648.0f) return 2147483647;
            return a <= -2147483648.0f ? -2147483647 - 1 : (int)a;
        }
    """,
    "_rem": """
        /* The remainder, exact up to 4096 times b: the products with both halves of b are exact. */
        static inline REAL {p}_rem(REAL a, REAL b)
        {
            const REAL size = a < 0 ? -a : a, d = b < 0 ? -b : b, turns = size / d;
            if (turns < 1.0f) return a;
            if (!(turns < 4194304.0f)) return NAN;
            const REAL n = (REAL)(int)turns, c = SPLITf * d, high = c - (c - d);
            REAL rest = (size - n * high) - n * (d - high);
            if (rest < 0) rest += d;
            if (rest >= d) rest -= d;
            return a < 0 ? -rest : rest;
        }
    """,
    "_floor": _FLOOR,
    "_round": """
        /* Halves to even. */
        static inline REAL {p}_round(REAL a)
        {
            if (!(a < WHOLEf && a > -WHOLEf)) return a;
            const REAL n = {p}_floor(a), rest = a - n;
            return rest > 0.5f || (rest == 0.5f && (int)n % 2 != 0) ? n + 1.0f : n;
        }
    """,
}


def _plain(real: str, traced: str, *, end: str, whole: str, split: str) -> Arithmetic:
    """One number of the C type ``real``, whose literals and functions have that ``end``.

    Beyond ``whole`` all are whole; ``split`` cuts one into halves (Dekker).
    """

    def put(code: str) -> str:
        code = code.replace("REAL", real).replace("WHOLE", whole).replace("SPLIT", split)
        return re.sub(r"(\d\.\d+)f\b", rf"\1{end}", code)

    functions = {name: f"{name}{end}" for name in _FUNCTIONS}
    forms = _FORMS | {name: f"{called}({{0}})" for name, called in functions.items()}
    return Arithmetic(
        traced, real, real, 4 if end else 8,
        {op: put(form) for op, form in forms.items()},
        {name: put(code) for name, code in _HELPERS.items()},
        functions,
    )  # fmt: skip


ARITHMETIC = {
    "float64": _plain("double", "float64", end="", whole="2147483648.0", split="134217729.0"),
    "float32": Arithmetic(
        "float64", "float", "{p}_real", 8, pairs.FORMS, pairs.HELPERS,
        {name: f"{name}f" for name in ("sqrt", "log", "atan")},
        wide="{p}_pair({0}, 0.0f)", narrow="{0}.h", zero="{p}_pair(0.0f, 0.0f)",
        plus="{p}_plus({0}, {1}, {2})", summed="{p}_pair({0}.h, {0}.l)",
    ),
    "single": _plain("float", "float32", end="f", whole="8388608.0", split="4097.0"),
}  # fmt: skip

"""A controller as one C header: no allocation, no loops of unknown length.

It is C99 and needs of the C library sinf, cosf, tanhf and expf, as far as the controller uses
them (and sqrtf or logf for a controller of your own that has them). Compile it without
-ffast-math: it relies on numbers that are not finite, and on exact differences in the remainder
of angles.

How close it is, on the same measurements: a torque differs from that of jax in float64 by less
than 1e-9 N m, whatever the controller, and so does the loop that it closes; in a "mixed" header,
which takes and gives float, by less than 1e-5 N m. In float32 a policy, with a history
or without, differs by some 1e-5 N m. An observer multiplies the rounding of an angle (2e-7 rad) by
the rate of its calls, and with that a guarded policy differs by up to 3e-3 N m: as much as jax does
in float32 from one compilation to the next. A loop that is closed in float32 drifts apart while it
swings up, because the motion multiplies rounding too. ``experiments/export.py`` measures it.
"""

import re
import textwrap
from collections import Counter

import numpy as np

from ..controller import Controller
from ..errors import JaxpendError
from .program import Leaf, Node, Program, is_constant, is_range, named
from .trace import trace

__all__ = ["source"]

# How an operation is written; {p} is the prefix of the header's names.
FORMS = {
    "add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "div": "{0} / {1}",
    "idiv": "{1} == 0 ? 0 : {0} / {1}", "rem": "{p}_rem({0}, {1})", "neg": "-{0}",
    "abs": "{0} < 0 ? -{0} : {0}", "sign": "{0} != {0} ? {0} : (float)(({0} > 0) - ({0} < 0))",
    "max": "({0} > {1} || {0} != {0}) ? {0} : {1}", "min": "({0} < {1} || {0} != {0}) ? {0} : {1}",
    "floor": "{p}_floor({0})", "ceil": "-{p}_floor(-{0})", "round": "{p}_round({0})",
    "sqrt": "sqrtf({0})", "exp": "expf({0})", "log": "logf({0})", "sin": "sinf({0})",
    "cos": "cosf({0})", "tanh": "tanhf({0})", "finite": "{0} - {0} == 0",
    "lt": "{0} < {1}", "le": "{0} <= {1}", "gt": "{0} > {1}", "ge": "{0} >= {1}",
    "eq": "{0} == {1}", "ne": "{0} != {1}", "and": "{0} && {1}", "or": "{0} || {1}",
    "not": "!{0}", "select": "{0} ? {1} : {2}", "int": "{p}_int({0})", "float": "(float){0}",
    "bool": "{0} != 0",
}  # fmt: skip
# Where the first argument cannot be NaN.
NUMBERS = {"max": "{0} > {1} ? {0} : {1}", "min": "{0} < {1} ? {0} : {1}"}
FUNCTIONS = {
    "sin": "sinf", "cos": "cosf", "tanh": "tanhf", "exp": "expf", "sqrt": "sqrtf", "log": "logf",
}  # fmt: skip
# What is computed along the rows of a matrix, by the operation of two arguments behind it.
ROWS = {"total": "add", "largest": "max", "smallest": "min"}
TYPES = {"float": "float", "int": "int", "bool": "int"}
HELPERS = {
    "_int": """
        /* Towards zero, at most what an int holds; 0 of NaN. */
        static inline int {p}_int(float a)
        {
            if (a != a) return 0;
            if (a >= 2147483648.0f) return 2147483647;
            return a <= -2147483648.0f ? -2147483647 - 1 : (int)a;
        }
    """,
    "_rem": """
        /* fmodf, exact up to 4096 times b: the products with both halves of b are exact. */
        static inline float {p}_rem(float a, float b)
        {
            const float size = a < 0 ? -a : a, d = b < 0 ? -b : b, turns = size / d;
            if (!(turns < 4194304.0f)) return a - a;
            if (turns < 1.0f) return a;
            const float n = (float)(int)turns, c = 4097.0f * d, high = c - (c - d);
            float rest = (size - n * high) - n * (d - high);
            if (rest < 0) rest += d;
            if (rest >= d) rest -= d;
            return a < 0 ? -rest : rest;
        }
    """,
    "_floor": """
        static inline float {p}_floor(float a)
        {
            if (!(a < 8388608.0f && a > -8388608.0f)) return a;
            const float n = (float)(int)a;
            return n > a ? n - 1.0f : n;
        }
    """,
    "_round": """
        /* Halves to even. */
        static inline float {p}_round(float a)
        {
            if (!(a < 8388608.0f && a > -8388608.0f)) return a;
            const float n = {p}_floor(a), rest = a - n;
            return rest > 0.5f || (rest == 0.5f && (int)n % 2 != 0) ? n + 1.0f : n;
        }
    """,
}
FILE = """\
/* The controller {name} of jaxpend, one step in C99; jaxpend.interop.c wrote it.
 *
 *     {p}_state state;
 *     {p}_init(&state);                    at the start of a run
 *     {p}_step(&state, t, x, torque);      at every period of the control
 *
 * t is the time in s, x the measured theta1, theta2 (rad), omega1, omega2 (rad/s), and torque gets
 * those of both joints in N m. Do not compile it with -ffast-math.
 *
 * A step takes at most {work} operations (arithmetic, comparisons, selections){calls};
 * no step is longer. The state has {state} bytes, the constants {constants}, the vectors on the
 * stack {stack}.
 */
#ifndef {guard}
#define {guard}

#include <math.h>

typedef struct {{
{struct}
}} {p}_state;
{helpers}
static inline void {p}_init({p}_state *s)
{{
{init}
}}

static inline void {p}_step({p}_state *s, float t, const float x[4], float torque[2])
{{
{step}
}}

#endif
"""
MIXED = """
/* Computed in double, since an observer multiplies the rounding of float. */
static inline void {p}_step({p}_state *s, float t, const float x[4], float torque[2])
{{
    const double wide[4] = {{x[0], x[1], x[2], x[3]}};
    double both[2];
    {p}_double(s, t, wide, both);
    torque[0] = (float)both[0];
    torque[1] = (float)both[1];
}}

#endif
"""
LOOP = "for (int i = 0; i < {}; ++i) "


# The limits of ``HELPERS`` that hang on the precision, in double.
LIMITS = {"8388608.0": "2147483648.0", "4097.0": "134217729.0"}


def source(
    controller: Controller, *, prefix: str = "controller", precision: str = "float64"
) -> str:
    """The text of a C header with ``PREFIX_state``, ``PREFIX_init`` and ``PREFIX_step``.

    A step is called as often as the controller is, every 0.002 s for a guarded one. Policies act
    without their ``action_noise``. A comment at its top has the worst-case count of operations.

    Args:
        controller: any that can be traced.
        prefix: of the names, an identifier.
        precision: "float64"; "mixed" for a header that computes in double, but takes and gives
            float; "float32" for a processor that has float alone.

    Raises:
        JaxpendError: as ``trace.trace``, an unknown precision, or a prefix that is no identifier
            of C.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", prefix):
        raise JaxpendError(f"the prefix {prefix!r} is no name in C; use letters, digits and _")
    if precision != "mixed":
        text = _printed(trace(controller, precision), prefix)
        return text if precision == "float32" else _in_double(text)
    text = _in_double(_printed(trace(controller, "float64"), prefix))
    text = text.replace(f"{prefix}_step({prefix}_state", f"{prefix}_double({prefix}_state")
    return text.replace("\n#endif\n", MIXED.format(p=prefix))


def _in_double(text: str) -> str:
    """A header that was printed for float, with the type, functions and limits of double."""
    text = re.sub(r"\bfloat\b", "double", text)
    text = re.sub(rf"\b({'|'.join(FUNCTIONS)})f\(", r"\1(", text)
    text = re.sub(r"\b(\d+\.\d*(?:e[+-]?\d+)?|\d+e[+-]?\d+)f\b", r"\1", text)
    return re.sub("|".join(map(re.escape, LIMITS)), lambda found: LIMITS[found[0]], text)


def _printed(program: Program, prefix: str) -> str:
    names = named(program.nodes, _literal, "s->s{}", "{}[{}]")
    step = [_table(node, names[node]) for node in program.tables]
    step += [line for node in program.steps for line in _lines(node, names, prefix)]
    step += ["(void)t, (void)x, (void)s;"]
    step += [f"torque[{i}] = {names[node]};" for i, node in enumerate(program.torque)]
    step += _kept(program, names)
    text = "\n".join(step)
    vectors = [node for node in program.steps if node.size]
    needed = {name for name in HELPERS if f"{prefix}{name}(" in text}
    needed |= {"_floor"} if "_round" in needed else set()
    helpers = [_dedented(code, prefix) for name, code in HELPERS.items() if name in needed]
    fields = [
        f"    {TYPES[leaf.kind]} s{number}[{leaf.initial.size}]; /* {leaf.path} */"
        for number, leaf in enumerate(program.state)
    ]
    work, calls = _counted(program)
    return FILE.format(
        name=program.name, p=prefix, guard=f"{prefix.upper()}_H", work=work, calls=calls,
        state=4 * sum(leaf.initial.size for leaf in program.state) or 4,
        constants=4 * sum(node.size or 0 for node in program.tables),
        stack=4 * sum(node.size or 0 for node in vectors),
        struct="\n".join(fields) or "    int none;",
        helpers="".join(f"\n{helper}\n" for helper in helpers),
        init="\n".join(_initial(program.state)),
        step=textwrap.indent(text, "    "),
    )  # fmt: skip


def _dedented(code: str, prefix: str) -> str:
    return textwrap.dedent(code).strip().replace("{p}", prefix)


def _literal(value: np.ndarray) -> str:
    """A number as C writes it."""
    number = value.item()
    if isinstance(number, float):
        if not np.isfinite(number):
            return "NAN" if number != number else f"({'-' if number < 0 else ''}INFINITY)"
        text = str(value.dtype.type(number))
        text = f"{text}f" if "." in text or "e" in text else f"{text}.0f"
        return f"({text})" if text.startswith("-") else text
    return f"({int(number)})" if number < 0 else str(int(number))


def _table(node: Node, name: str) -> str:
    numbers = ", ".join(_literal(entry).strip("()") for entry in node.value)
    text = textwrap.fill(numbers, 92, initial_indent="    ", subsequent_indent="    ")
    return f"static const {TYPES[node.kind]} {name}[{node.size}] = {{\n{text}\n}};"


def _initial(state: tuple[Leaf, ...]) -> list[str]:
    lines = [] if state else ["    s->none = 0;"]
    for number, leaf in enumerate(state):
        first = leaf.initial[0]
        if leaf.scalar or not (leaf.initial == first).all():
            entries = enumerate(map(_literal, leaf.initial))
            lines += [f"    s->s{number}[{i}] = {entry};" for i, entry in entries]
        else:
            loop = LOOP.format(leaf.initial.size)
            lines.append(f"    {loop}s->s{number}[i] = {_literal(first)};")
    return lines


def _kept(program: Program, names: dict[Node, str]) -> list[str]:
    """Write the new state, after all that needs the old one."""
    first, then = [], []
    for number, (leaf, after) in enumerate(zip(program.state, program.next_state, strict=True)):
        for place, node in enumerate(after):
            to, value = f"s->s{number}", names[node]
            if node.op == "state":  # it may be overwritten before it is read
                if node.value == (number, place if leaf.scalar else None):
                    continue
                old = f"old{number}_{place}"
                first += _copied(node, value, f"{TYPES[node.kind]} {old}")
                value = old
            if leaf.scalar:
                then.append(f"{to}[{place}] = {value};")
            else:
                then.append(f"{LOOP.format(node.size)}{to}[i] = {value}[i];")
    return first + then


def _copied(node: Node, value: str, declared: str) -> list[str]:
    if node.size is None:
        return [f"const {declared} = {value};"]
    name = declared.split()[-1]
    return [f"{declared}[{node.size}];", f"{LOOP.format(node.size)}{name}[i] = {value}[i];"]


def _lines(node: Node, names: dict[Node, str], prefix: str) -> list[str]:
    """The statements that compute a node."""
    name, kind = names[node], TYPES[node.kind]
    args = [names[arg] for arg in node.args]
    if node.size is None:
        return [f"const {kind} {name} = {_entry(node, args, prefix)};"]
    lines, loop = [f"{kind} {name}[{node.size}];"], LOOP.format(node.size)
    if node.op == "pack":
        return lines + [f"{name}[{i}] = {arg};" for i, arg in enumerate(args)]
    if node.op == "concat":
        start = 0
        for arg, part in zip(args, node.args, strict=True):
            lines.append(f"{LOOP.format(part.size)}{name}[{start} + i] = {arg}[i];")
            start += part.size or 0
        return lines
    if node.op == "matmul":
        return lines + _product(node, name, args)
    if node.op in ROWS:
        return lines + _of_rows(node, name, args[0])
    if node.op == "take":
        index = node.args[1]
        place = f"{int(index.value[0])} + i" if is_range(index) else f"{args[1]}[i]"
        return [*lines, f"{loop}{name}[i] = {args[0]}[{place}];"]
    each = [f"{a}[i]" if arg.size else a for a, arg in zip(args, node.args, strict=True)]
    return [*lines, f"{loop}{name}[i] = {_entry(node, each, prefix)};"]


def _entry(node: Node, args: list[str], prefix: str) -> str:
    """A scalar, or an entry of a vector."""
    if node.op == "item":
        return f"{args[0]}[{node.value}]"
    if node.op == "take":
        return f"{args[0]}[{args[1]}]"
    first = node.args[0]
    sure = node.op in NUMBERS and (first.kind != "float" or is_constant(first))
    return (NUMBERS if sure else FORMS)[node.op].format(*args, p=prefix)


def _product(node: Node, name: str, args: list[str]) -> list[str]:
    m, k, n = node.value
    a, b = args
    return [
        f"for (int r = 0; r < {m}; ++r) {{",
        f"    for (int c = 0; c < {n}; ++c) {name}[r * {n} + c] = 0;",
        f"    for (int i = 0; i < {k}; ++i) {{",
        f"        const float factor = {a}[r * {k} + i];",
        f"        for (int c = 0; c < {n}; ++c) {name}[r * {n} + c] += factor * {b}[i * {n} + c];",
        "    }",
        "}",
    ]


def _of_rows(node: Node, name: str, arg: str) -> list[str]:
    m, k = node.value
    each = FORMS[ROWS[node.op]].format(f"{name}[r]", f"{arg}[r * {k} + i]")
    return [
        f"for (int r = 0; r < {m}; ++r) {{",
        f"    {name}[r] = {arg}[r * {k}];",
        f"    for (int i = 1; i < {k}; ++i) {name}[r] = {each};",
        "}",
    ]


def _counted(program: Program) -> tuple[int, str]:
    """Operations of a step, and in words the calls of the C library and of the remainder."""
    work, calls = 0, Counter[str]()
    for node in program.steps:
        size = node.size or 1
        if node.op == "matmul":
            m, k, n = node.value
            work += 2 * m * k * n
        elif node.op in ROWS:
            work += node.value[0] * node.value[1]
        elif node.op in FUNCTIONS or node.op == "rem":
            calls[FUNCTIONS.get(node.op, "the remainder of a division")] += size
        elif node.op not in ("item", "take", "pack", "concat"):
            work += size
    said = [f"{count} of {name}" for name, count in sorted(calls.items())]
    return work, f" and these calls:\n * {', '.join(said)}" if said else ""

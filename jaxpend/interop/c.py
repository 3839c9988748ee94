"""A controller as one C header: no allocation, no loops of unknown length.

It is C99 and needs no more of the C library than sinf, cosf, tanhf and expf, as far as the
controller uses them, and none of these in "float32", which has fmaf where that is an instruction
(sqrtf, logf or atanf are for a controller of your own that has them, or an observer of a plant
with Coulomb friction). It relies on numbers that are not finite and on exact differences, and does
not compile with -ffast-math; a compiler that fuses products and sums without saying so, by
FP_FAST_FMAF, has to be told not to.

How it computes is one of ``arithmetic.ARITHMETIC``. On the same measurements a torque differs from
that of jax in float64, whatever the controller,

- in "float32" by less than 1e-5 N m: float goes in and comes out, and pairs of floats compute, so
  that a processor that has nothing else can keep up;
- in "float64" by less than 1e-9 N m, and so does the loop that it closes;
- in "single", one float for a number, which is the fastest, by 1e-6 to 4e-3 N m: an observer
  multiplies the rounding of an angle (2e-7 rad) by the rate of its calls. Jax in float32 is as far
  off, and differs by as much from one compilation to the next.

A loop that is closed through measurements in float drifts apart while it swings up, because the
motion multiplies their rounding too. ``experiments/export.py`` measures all this.
"""

import re
import textwrap
from collections import Counter

import numpy as np

from ..controller import Controller
from ..errors import JaxpendError, choose
from .arithmetic import ARITHMETIC, Arithmetic, work
from .program import Node, Program, is_constant, is_range, named
from .trace import trace

__all__ = ["source"]

# Operations on what is no number: integers and truth values.
WHOLE = {
    "add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "neg": "-{0}",
    "idiv": "{1} == 0 ? 0 : {0} / {1}", "abs": "{0} < 0 ? -{0} : {0}",
    "sign": "({0} > 0) - ({0} < 0)", "max": "{0} > {1} ? {0} : {1}",
    "min": "{0} < {1} ? {0} : {1}", "lt": "{0} < {1}", "le": "{0} <= {1}", "gt": "{0} > {1}",
    "ge": "{0} >= {1}", "eq": "{0} == {1}", "ne": "{0} != {1}", "and": "{0} && {1}",
    "or": "{0} || {1}", "not": "!{0}", "select": "{0} ? {1} : {2}", "int": "{0}",
    "bool": "{0} != 0",
}  # fmt: skip
# What is computed along the rows of a matrix, by the operation of two arguments behind it.
ROWS = {"total": "add", "largest": "max", "smallest": "min"}
MOVES = ("item", "take", "pack", "concat")
LOOP = "for (int i = 0; i < {}; ++i) "
HEADS = re.compile(r"\bfor \(.*?\+\+\w\) |\[[^\]]*\]")  # of loops, and indices
P = {"p": "{p}"}  # the prefix of names, which comes last
FILE = """\
/* The controller {name} of jaxpend, one step in C99; jaxpend.interop.c wrote it.
 *
 *     {p}_state state;
 *     {p}_init(&state);                    at the start of a run
 *     {p}_step(&state, t, x, torque);      at every period of the control
 *
 * t is the time in s, x the measured theta1, theta2 (rad), omega1, omega2 (rad/s), and torque gets
 * those of both joints in N m. Do not compile it with -ffast-math.{pairs}
 *
 * A step takes at most {work} operations (arithmetic, comparisons, selections){calls};
 * no step is longer. The state has {state} bytes, the constants {constants}, the vectors on the
 * stack {stack}.
 */
#ifndef {guard}
#define {guard}

#include <math.h>

#if defined __FAST_MATH__ || defined __ASSOCIATIVE_MATH__ || (__FINITE_MATH_ONLY__ + 0)
#error "compile this file without -ffast-math and its parts: it relies on exact differences"
#endif
{typedef}
typedef struct {{
{struct}
}} {p}_state;
{helpers}
static inline void {p}_init({p}_state *s)
{{
{init}
}}

static inline void {p}_step({p}_state *s, {given} t, const {given} x[4], {given} torque[2])
{{
{step}
}}

#endif
"""
PAIRS = """
 * A number is the sum of two floats, h and l, of which l is the rounding error of h."""
TYPEDEF = """
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#endif
#include <float.h>
#if FLT_EVAL_METHOD
#error "compile this file for arithmetic in float, for x86 with -mfpmath=sse"
#endif

typedef struct { float h, l; } {p}_real;
"""


def source(
    controller: Controller, *, prefix: str = "controller", precision: str = "float32"
) -> str:
    """The text of a C header with ``PREFIX_state``, ``PREFIX_init`` and ``PREFIX_step``.

    A step is called as often as the controller is, every 0.002 s for a guarded one. Policies act
    without their ``action_noise``. A comment at its top has the worst-case count of operations.

    Args:
        controller: any that can be traced.
        prefix: of the names, an identifier.
        precision: "float32", which takes and gives float and computes with pairs of floats;
            "float64"; or "single", with one float for a number.

    Raises:
        JaxpendError: as ``trace.trace``, an unknown precision, or a prefix that is no identifier
            of C.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", prefix):
        raise JaxpendError(f"the prefix {prefix!r} is no name in C; use letters, digits and _")
    arithmetic = ARITHMETIC[choose("precision", precision, ARITHMETIC)]
    program = trace(controller, arithmetic.traced)
    return _Printer(program, arithmetic).text(prefix)


def _said(text: str) -> str:
    """A name of the user's, which must not end the comment that it is in."""
    return text.replace("*/", "* /")


class _Printer:
    """Prints one program with one arithmetic; {p} stands for the prefix until the end."""

    def __init__(self, program: Program, arithmetic: Arithmetic):
        self.program, self.arithmetic, self.real = program, arithmetic, arithmetic.real
        self.types = {"float": self.real, "int": "int", "bool": "int"}
        self.width = {"float": arithmetic.width, "int": 4, "bool": 4}
        self.names = named(program.nodes, self.literal, "s->s{}", "{}[{}]")
        # Tables whose entries are floats, though numbers are more than that.
        self.exact = {
            node for node in program.tables
            if node.kind == "float" and arithmetic.exact(node.value)
        }  # fmt: skip
        for node in program.nodes:
            if node.op in ("t", "x"):
                self.names[node] = self.wide(self.names[node])

    def wide(self, name: str) -> str:
        return self.arithmetic.wide.format(name, p="{p}")

    def text(self, prefix: str) -> str:
        program, paired = self.program, self.arithmetic.paired
        step = [self.table(node) for node in program.tables]
        step += [line for node in program.steps for _, line in self.lines(node)]
        step += ["(void)t, (void)x, (void)s;"]
        torque = (self.arithmetic.narrow.format(self.names[node]) for node in program.torque)
        step += [f"torque[{i}] = {value};" for i, value in enumerate(torque)]
        step += self.kept()
        text, init = "\n".join(step), "\n".join(self.initial())
        total, calls = self.counted()
        fields = [
            f"    {self.types[leaf.kind]} s{number}[{leaf.initial.size}]; /* {_said(leaf.path)} */"
            for number, leaf in enumerate(program.state)
        ]
        state = sum(self.width[leaf.kind] * leaf.initial.size for leaf in program.state)
        vectors = [node for node in program.steps if node.size]
        return FILE.format(
            name=program.name, p="{p}", guard=f"{prefix.upper()}_H", given=self.arithmetic.given,
            pairs=PAIRS if paired else "", typedef=TYPEDEF if paired else "",
            work=total, calls=calls, state=state or 4,
            constants=sum(map(self.bytes, program.tables)),
            stack=sum(map(self.bytes, vectors)), struct="\n".join(fields) or "    int none;",
            helpers="".join(f"\n{helper}\n" for helper in self.helpers(text + init)),
            init=init, step=textwrap.indent(text, "    "),
        ).replace("{p}", prefix)  # fmt: skip

    def bytes(self, node: Node) -> int:
        return (4 if node in self.exact else self.width[node.kind]) * (node.size or 0)

    def helpers(self, text: str) -> list[str]:
        """Those that a text needs, and those that they need, in order."""
        found: list[str] = []
        for name, code in reversed(list(self.arithmetic.helpers.items())):
            code = textwrap.dedent(code).strip()
            if f"{{p}}{name}(" in text:
                text += code
                found.insert(0, code)
        return found

    def literal(self, value: np.ndarray) -> str:
        """A number as C writes it in an expression."""
        number = value.dtype.kind == "f"
        text = self.arithmetic.literal(value) if number else str(int(value.item()))
        return f"({text})" if text.startswith("-") else text

    def table(self, node: Node) -> str:
        exact = node in self.exact
        if node.kind == "float":
            numbers = [self.arithmetic.entry(entry, exact) for entry in node.value]
        else:
            numbers = [str(int(entry)) for entry in node.value]
        kind = "float" if exact else self.types[node.kind]
        text = textwrap.fill(
            ", ".join(numbers), 92, initial_indent="    ", subsequent_indent="    "
        )
        return f"static const {kind} {self.names[node]}[{node.size}] = {{\n{text}\n}};"

    def initial(self) -> list[str]:
        state = self.program.state
        lines = [] if state else ["    s->none = 0;"]
        for number, leaf in enumerate(state):
            first = leaf.initial[0]
            if leaf.scalar or not (leaf.initial == first).all():
                entries = enumerate(map(self.literal, leaf.initial))
                lines += [f"    s->s{number}[{i}] = {entry};" for i, entry in entries]
            else:
                loop = LOOP.format(leaf.initial.size)
                lines.append(f"    {loop}s->s{number}[i] = {self.literal(first)};")
        return lines

    def kept(self) -> list[str]:
        """Write the new state, after all that needs the old one."""
        first, then = [], []
        pairs = zip(self.program.state, self.program.next_state, strict=True)
        for number, (leaf, after) in enumerate(pairs):
            for place, node in enumerate(after):
                to, value = f"s->s{number}", self.names[node]
                if node.op == "state":  # it may be overwritten before it is read
                    if node.value == (number, place if leaf.scalar else None):
                        continue
                    old = f"old{number}_{place}"
                    first += self.copied(node, value, old)
                    value = old
                if leaf.scalar:
                    then.append(f"{to}[{place}] = {value};")
                else:
                    entry = self.wide(f"{value}[i]") if node in self.exact else f"{value}[i]"
                    then.append(f"{LOOP.format(node.size)}{to}[i] = {entry};")
        return first + then

    def copied(self, node: Node, value: str, name: str) -> list[str]:
        kind = self.types[node.kind]
        if node.size is None:
            return [f"const {kind} {name} = {value};"]
        return [f"{kind} {name}[{node.size}];", f"{LOOP.format(node.size)}{name}[i] = {value}[i];"]

    def entry_of(self, node: Node, index: object) -> str:
        """An entry of a vector, as a number to compute with."""
        text = f"{self.names[node]}[{index}]"
        return self.wide(text) if node in self.exact else text

    def lines(self, node: Node) -> list[tuple[int, str]]:
        """The statements that compute a node, each with how often it is carried out."""
        name, kind, size = self.names[node], self.types[node.kind], node.size
        if size is None:
            args = [self.names[arg] for arg in node.args]
            return [(1, f"const {kind} {name} = {self.value(node, args)};")]
        lines, loop = [(0, f"{kind} {name}[{size}];")], LOOP.format(size)
        if node.op == "pack":
            names = enumerate(self.names[arg] for arg in node.args)
            return lines + [(1, f"{name}[{i}] = {arg};") for i, arg in names]
        if node.op == "concat":
            start = 0
            for part in node.args:
                count, entry = part.size or 0, self.entry_of(part, "i")
                lines.append((count, f"{LOOP.format(count)}{name}[{start} + i] = {entry};"))
                start += count
            return lines
        if node.op == "matmul":
            return lines + self.product(node)
        if node.op in ROWS or node.op == "sums":
            return lines + self.of_rows(node)
        if node.op == "take":
            vector, index = node.args
            place = f"{self.names[index]}[i]"
            place = f"{int(index.value[0])} + i" if is_range(index) else place
            return [*lines, (size, f"{loop}{name}[i] = {self.entry_of(vector, place)};")]
        each = [self.entry_of(arg, "i") if arg.size else self.names[arg] for arg in node.args]
        return [*lines, (size, f"{loop}{name}[i] = {self.value(node, each)};")]

    def value(self, node: Node, args: list[str]) -> str:
        """A scalar, or an entry of a vector."""
        if node.op in ("item", "take"):
            return self.entry_of(node.args[0], node.value if node.op == "item" else args[1])
        return self.form(node.op, node.args[0]).format(*args, **P)

    def form(self, op: str, first: Node) -> str:
        """How an operation is written, by its first argument."""
        if op == "float":
            return self.arithmetic.forms["from int"]
        if first.kind != "float":
            return WHOLE[op]
        sure = f"sure {op}"
        if is_constant(first) and sure in self.arithmetic.forms:
            return self.arithmetic.forms[sure]
        return self.arithmetic.forms[op]

    def product(self, node: Node) -> list[tuple[int, str]]:
        m, k, n = node.value
        (a, b), name, arithmetic = node.args, self.names[node], self.arithmetic
        entry, factor = f"{name}[r * {n} + c]", self.entry_of(a, f"r * {k} + i")
        other = f"{self.names[b]}[i * {n} + c]"
        if b in self.exact or not arithmetic.paired:
            more = arithmetic.plus.format(entry, "factor", other, **P)
        else:
            product = arithmetic.forms["mul"].format("factor", other, **P)
            more = arithmetic.forms["add"].format(entry, product, **P)
        each = f"for (int c = 0; c < {n}; ++c) {entry}"
        lines = [
            (0, f"for (int r = 0; r < {m}; ++r) {{"),
            (m * n, f"    {each} = {arithmetic.zero};"),
            (0, f"    for (int i = 0; i < {k}; ++i) {{"),
            (m * k, f"        const {self.real} factor = {factor};"),
            (m * k * n, f"        {each} = {more};"),
            (0, "    }"),
        ]
        if arithmetic.summed:
            lines.append((m * n, f"    {each} = {arithmetic.summed.format(entry, **P)};"))
        return [*lines, (0, "}")]

    def of_rows(self, node: Node) -> list[tuple[int, str]]:
        """An operation along rows: its last result, or for ``sums`` all of them."""
        m, k = node.value
        name, (arg,), running = self.names[node], node.args, node.op == "sums"
        first, before, after = (
            (f"r * {k}", f"r * {k} + i - 1", f"r * {k} + i") if running else ("r", "r", "r")
        )
        each = self.form("add" if running else ROWS[node.op], node).format(
            f"{name}[{before}]", self.entry_of(arg, f"r * {k} + i"), **P
        )
        start = self.entry_of(arg, f"r * {k}")
        return [
            (0, f"for (int r = 0; r < {m}; ++r) {{"),
            (m, f"    {name}[{first}] = {start};"),
            (m * (k - 1), f"    for (int i = 1; i < {k}; ++i) {name}[{after}] = {each};"),
            (0, "}"),
        ]

    def counted(self) -> tuple[int, str]:
        """Operations of a step, and in words the calls of the C library."""
        total, calls = 0, Counter[str]()
        for node in self.program.steps:
            for times, line in self.lines(node):
                statement = HEADS.sub("", line)
                least = 0 if node.op in MOVES or " = " not in statement else 1
                total += times * max(work(statement, self.arithmetic.helpers), least)
            if called := self.arithmetic.functions.get(node.op):
                calls[called] += node.size or 1
        said = [f"{count} of {name}" for name, count in sorted(calls.items())]
        return total, f" and these calls:\n * {', '.join(said)}" if said else ""

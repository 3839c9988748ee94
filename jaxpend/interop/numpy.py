"""A controller as one Python file that needs numpy alone, in float64.

Scalars are Python's floats, which are some ten times as fast as arrays of one entry; layers of a
network and other vectors are numpy's. Numbers that are not finite pass through as they do in
jax: nothing raises. On the same measurements the torques are those of the controller in float64
to about 1e-12 N m, also of a guarded one in a closed loop of 10 s, which multiplies rounding.
"""

import keyword
import textwrap

import numpy as np

from ..controller import Controller
from ..errors import JaxpendError
from .program import Leaf, Node, Program, is_constant, is_range, named
from .trace import trace

__all__ = ["source"]

MAX, MIN = "{0} if {0} > {1} or {0} != {0} else {1}", "{0} if {0} < {1} or {0} != {0} else {1}"
# How an operation is written on scalars, and on vectors.
SCALAR = {
    "add": "{} + {}", "sub": "{} - {}", "mul": "{} * {}", "div": "_div({}, {})",
    "idiv": "_idiv({}, {})", "rem": "_rem({}, {})", "neg": "-{}", "abs": "abs({})", "max": MAX,
    "min": MIN, "sign": "_sign({})", "floor": "_floor({})", "ceil": "-_floor(-{})",
    "round": "_round({})", "sqrt": "_sqrt({})", "exp": "_exp({})", "log": "_log({})",
    "sin": "_sin({})", "cos": "_cos({})", "tanh": "math.tanh({})", "atan": "math.atan({})",
    "finite": "math.isfinite({})", "lt": "{} < {}", "le": "{} <= {}", "gt": "{} > {}",
    "ge": "{} >= {}", "eq": "{} == {}", "ne": "{} != {}", "and": "{} and {}",
    "or": "{} or {}", "not": "not {}",
    "select": "{1} if {0} else {2}", "int": "_int({})", "float": "float({})", "bool": "{} != 0",
}  # fmt: skip
VECTOR = SCALAR | {
    "div": "{} / {}", "idiv": "np.trunc({} / {}).astype(int)", "rem": "np.fmod({}, {})",
    "abs": "np.abs({})", "max": "np.maximum({}, {})", "min": "np.minimum({}, {})",
    "sign": "np.sign({})", "floor": "np.floor({})", "ceil": "np.ceil({})", "round": "np.rint({})",
    "sqrt": "np.sqrt({})", "exp": "np.exp({})", "log": "np.log({})", "sin": "np.sin({})",
    "cos": "np.cos({})", "tanh": "np.tanh({})", "atan": "np.arctan({})",
    "finite": "np.isfinite({})",
    "and": "np.logical_and({}, {})", "or": "np.logical_or({}, {})", "not": "np.logical_not({})",
    "select": "np.where({}, {}, {})", "int": "_ints({})", "float": "np.asarray({}, float)",
}  # fmt: skip
HELPERS = {
    "_div": """
        if b != 0:
            return a / b
        return math.nan if a == 0 or a != a else math.copysign(math.inf, a) * math.copysign(1, b)
    """,
    "_idiv": "return 0 if b == 0 else abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)",
    "_rem": "return math.fmod(a, b) if math.isfinite(a) and b != 0 else math.nan",
    "_sign": "return float((a > 0) - (a < 0)) if a == a else a",
    "_floor": "return float(math.floor(a)) if math.isfinite(a) else a",
    "_round": "return float(round(a)) if math.isfinite(a) else a",
    "_sqrt": "return math.sqrt(a) if a >= 0 else math.nan",
    "_exp": "return math.exp(a) if not a > 709 else float(np.exp(a))",
    "_log": "return math.log(a) if a > 0 else (-math.inf if a == 0 else math.nan)",
    "_sin": "return math.sin(a) if math.isfinite(a) else math.nan",
    "_cos": "return math.cos(a) if math.isfinite(a) else math.nan",
    "_int": "return 0 if a != a else int(min(max(a, -2147483648.0), 2147483647.0))",
    "_ints": "return np.clip(np.nan_to_num(a), -2147483648, 2147483647).astype(int)",
}
OF_TWO = ("_div", "_idiv", "_rem")
ROWS = {"total": "sum", "largest": "max", "smallest": "min"}


def source(controller: Controller, *, class_name: str = "Controller") -> str:
    """The text of a Python file with the class ``class_name``.

    Its objects have ``reset()``, which forgets what was measured, and ``torque(t, x)``: time in s
    and the measured state (4,) to the torques (2,), N m, a float64 array. A new object is reset.
    It is called as often as the controller is, every 0.002 s for a guarded one. Policies act
    without their ``action_noise``.

    Args:
        controller: any that can be traced; load it in float64 (``jax.enable_x64(True)``), or its
            numbers are those of float32.
        class_name: an identifier.

    Raises:
        JaxpendError: as ``trace.trace``, or a name that Python cannot have.
    """
    if not class_name.isidentifier() or keyword.iskeyword(class_name):
        raise JaxpendError(f"the class name {class_name!r} is no name in Python; use letters")
    return _printed(trace(controller, "float64"), class_name)


def _printed(program: Program, class_name: str) -> str:
    names = named(program.nodes, _literal, "s{}", "{}_{}")
    body = [f"{names[node]} = {_expression(node, names)}" for node in program.steps]
    text = "\n".join(body)
    helpers = [_helper(name, code) for name, code in HELPERS.items() if f"{name}(" in text]
    states = ", ".join(_initial(leaf) for leaf in program.state)
    after = [
        _tuple([names[node] for node in leaf]) if of.scalar else names[leaf[0]]
        for leaf, of in zip(program.next_state, program.state, strict=True)
    ]
    unpacked = [
        _tuple([f"s{n}_{i}" for i in range(leaf.initial.size)]) if leaf.scalar else f"s{n}"
        for n, leaf in enumerate(program.state)
    ]
    step = [f"{_tuple(unpacked)} = self._state"] if unpacked else []
    torque = ", ".join(names[node] for node in program.torque)
    step += ["t = float(t)", "x_0, x_1, x_2, x_3 = (float(entry) for entry in x)"]
    step += ['with np.errstate(all="ignore"):', *(f"    {line}" for line in body)] if body else []
    step += [f"self._state = {_tuple(after)}", f"return np.array([{torque}], float)"]
    return FILE.format(
        name=program.name,
        helpers="".join(f"\n\n{helper}\n" for helper in helpers),
        tables="".join(f"\n{table}" for table in _tables(program, names)),
        class_name=class_name,
        states=f"({states},)" if states else "()",
        step=textwrap.indent("\n".join(step), " " * 8),
    )


FILE = '''"""The controller {name} of jaxpend, one step in numpy; jaxpend.interop.numpy wrote it."""

import math

import numpy as np
{helpers}{tables}


class {class_name}:
    """Torques from measured states; called in the order of time, at the period of the control."""

    def __init__(self):
        self.reset()

    def reset(self):
        """Forget what was measured: for the start of a run."""
        self._state = {states}

    def torque(self, t, x):
        """Torques (2,), N m, at time t (s) from theta1, theta2, omega1, omega2 (rad, rad/s)."""
{step}
'''


def _number(value: np.ndarray) -> str:
    """A number as Python writes it."""
    value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return "math.nan" if value != value else f"{'-' if value < 0 else ''}math.inf"
    return repr(value)


def _literal(value: np.ndarray) -> str:
    text = _number(value)
    return f"({text})" if text.startswith("-") else text


def _tuple(parts: list[str]) -> str:
    return f"({', '.join(parts)}{',' if len(parts) == 1 else ''})"


def _initial(leaf: Leaf) -> str:
    if leaf.scalar:
        return _tuple([_number(entry) for entry in leaf.initial])
    first = leaf.initial[0]
    if (leaf.initial == first).all():
        return f"np.full({leaf.initial.size}, {_number(first)})"
    return f"np.array([{', '.join(map(_number, leaf.initial))}])"


def _tables(program: Program, names: dict[Node, str]) -> list[str]:
    """Vectors of numbers, and as matrices where they are factors of products."""
    lines = [f"{names[node]} = {_array(node.value)}" for node in program.tables]
    for node in program.steps:
        if node.op == "matmul":
            m, k, n = node.value
            for factor, shape in zip(node.args, ((m, k), (k, n)), strict=True):
                if factor.op == "constant":
                    line = f"{_matrix(names[factor], *shape)} = {names[factor]}.reshape{shape}"
                    lines += [line] if line not in lines else []
    return lines


def _array(values: np.ndarray) -> str:
    """Numbers, in as few digits as are exact."""
    single = values.dtype.kind == "f" and (values == values.astype("f4")).all()
    shown = values.astype("f4") if single else values
    numbers = [str(entry) for entry in shown] if single else list(map(_number, shown))
    text = textwrap.fill(", ".join(numbers), 96, initial_indent="    ", subsequent_indent="    ")
    end = ', dtype="f4").astype(float)' if single else ")"
    return f"np.array([\n{text}\n]{end}"


def _matrix(name: str, rows: int, columns: int) -> str:
    return f"{name}_{rows}x{columns}"


def _expression(node: Node, names: dict[Node, str]) -> str:
    args = [names[arg] for arg in node.args]
    if node.op in SCALAR:
        forms = SCALAR if node.size is None else VECTOR
        nonzero = is_constant(node.args[-1]) and not is_constant(node.args[-1], 0)
        form = "{} / {}" if node.op == "div" and nonzero else forms[node.op]
        return form.format(*args)
    if node.op == "item":
        return f"{args[0]}.item({node.value})"
    if node.op in ROWS:
        m, k = node.value
        return f"{args[0]}.reshape({m}, {k}).{ROWS[node.op]}(1)"
    if node.op == "sums":
        return f"{args[0]}.reshape{node.value}.cumsum(1).ravel()"
    if node.op == "pack":
        return f"np.array([{', '.join(args)}])"
    if node.op == "concat":
        return f"np.concatenate([{', '.join(args)}])"
    if node.op == "take":
        return _taken(node, args)
    return _product(node, args)


def _taken(node: Node, args: list[str]) -> str:
    index = node.args[1]
    if index.size is None:
        return f"{args[0]}.item({args[1]})"
    if is_range(index):
        first = int(index.value[0])
        return f"{args[0]}[{first}:{first + (index.size or 0)}]"
    return f"{args[0]}[{args[1]}]"


def _product(node: Node, args: list[str]) -> str:
    m, k, n = node.value
    shapes = ((m, k), (k, n))
    factors = []
    for arg, name, shape in zip(node.args, args, shapes, strict=True):
        if 1 in (m, n) and arg.size == k:
            factors.append(name)
        elif arg.op == "constant":
            factors.append(_matrix(name, *shape))
        else:
            factors.append(f"{name}.reshape{shape}")
    form = "({} @ {}).ravel()" if m > 1 and n > 1 else "np.atleast_1d({} @ {})"
    return form.format(*factors)


def _helper(name: str, code: str) -> str:
    lines = textwrap.indent(textwrap.dedent(code).strip("\n").rstrip(), "    ")
    return f"def {name}({'a, b' if name in OF_TWO else 'a'}):\n{lines}"

"""A controller step as a straight-line program, from which the printers of this folder print.

A program has nodes of two forms: scalars, and flat vectors for what is large, such as the layers
of a network. Everything that only moves numbers about (slices, transposes, concatenations) is
either gone or a ``take``. There are no loops and no branches.

    constant              a number, or a vector of numbers; ``value``
    t, x, state           the inputs; ``value`` is the entry of x, or (leaf, entry) of the state,
                          whose entry is None for a whole leaf
    FOLDS                 entry by entry; a scalar argument beside vectors counts for every entry
    item, take            the entry ``value``, or the entries args[1] of the vector args[0]
    pack, concat          a vector of scalars, a vector of vectors
    matmul                (m, k) times (k, n), both flat; ``value`` is (m, k, n)
    total, largest, smallest   of every row of (m, k), flat; ``value`` is (m, k)
    sums                  of every row of (m, k) its running sums, (m, k), flat
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

__all__ = ["KINDS", "Builder", "Leaf", "Node", "Program", "is_constant", "is_range", "named"]


@dataclasses.dataclass(frozen=True, eq=False)
class Node:
    """A value in a program; two nodes of one ``Builder`` are the same value if they are one."""

    op: str
    args: tuple["Node", ...] = ()
    kind: str = "float"  # or "int" or "bool"
    size: int | None = None  # of a vector; None: a scalar
    value: Any = None


@dataclasses.dataclass(frozen=True)
class Leaf:
    """An array of a controller's memory, flat."""

    path: str  # where it is in the memory, as jax writes it
    kind: str
    initial: np.ndarray  # (size,) after a reset
    scalar: bool  # whether the program has its entries one by one


@dataclasses.dataclass(frozen=True)
class Program:
    """One step of a controller: state, time and measured state in, state and torque out."""

    name: str  # of the controller's class
    precision: str  # "float32" or "float64"
    state: tuple[Leaf, ...]
    next_state: tuple[tuple[Node, ...], ...]  # of a leaf: its entries, or one vector
    torque: tuple[Node, Node]  # N m

    @property
    def types(self) -> dict[str, np.dtype]:
        """The type in numpy of every kind of node."""
        return _types_of(self.precision)

    @property
    def outputs(self) -> tuple[Node, ...]:
        """What a step computes."""
        return tuple(node for leaf in self.next_state for node in leaf) + self.torque

    @property
    def steps(self) -> list[Node]:
        """Those of ``nodes`` that are computed: no constants and inputs."""
        return [node for node in self.nodes if node.op not in ("constant", "state", "t", "x")]

    @property
    def tables(self) -> list[Node]:
        """The vectors of constants that have to be written down: all but ranges to ``take``."""
        used = [*self.outputs]
        for node in self.steps:
            ranged = node.op == "take" and is_range(node.args[1])
            used += node.args[:1] if ranged else node.args
        return list(dict.fromkeys(node for node in used if is_constant(node) and node.size))

    @property
    def nodes(self) -> list[Node]:
        """All that the outputs need, in an order in which it can be computed."""
        return _ordered(self.outputs)


def _ordered(outputs: Iterable[Node]) -> list[Node]:
    """The nodes that ``outputs`` need and themselves, arguments first."""
    found: dict[int, Node] = {}
    stack = [(node, False) for node in reversed(list(outputs))]
    while stack:
        node, ready = stack.pop()
        if id(node) in found:
            continue
        if ready:
            found[id(node)] = node
        else:
            stack.append((node, True))
            stack += [(arg, False) for arg in reversed(node.args)]
    return list(found.values())


def named(
    nodes: Iterable[Node], literal: Callable[[np.ndarray], str], leaf: str, entry: str
) -> dict[Node, str]:
    """What a printer calls nodes: scalar constants are written out, other vectors of them C1, ...

    Args:
        nodes: in order.
        literal: writes a number.
        leaf: the name of a leaf of the state, with {} for its number.
        entry: the name of an entry, with {} for the leaf or ``x``, and {} for its number.
    """
    names = {}
    for count, node in enumerate(nodes):
        if node.op == "constant":
            names[node] = literal(node.value) if node.size is None else f"C{count}"
        elif node.op == "state":
            number, place = node.value
            name = leaf.format(number)
            names[node] = name if place is None else entry.format(name, place)
        elif node.op in ("t", "x"):
            names[node] = "t" if node.op == "t" else entry.format("x", node.value)
        else:
            names[node] = f"v{count}"
    return names


def is_constant(node: Node, value: Any = None) -> bool:
    """Whether a node is a constant; with ``value`` whether it is that number, everywhere."""
    return node.op == "constant" and (value is None or bool(np.all(node.value == value)))


def is_range(node: Node) -> bool:
    """Whether it is a vector of whole numbers one after the other: a slice, then, in ``take``."""
    whole = is_constant(node) and node.kind == "int" and node.size is not None
    return whole and bool((np.diff(node.value) == 1).all())


def _to_int(a: Any) -> np.ndarray:
    """Towards zero, at most what 32 bits hold; 0 of NaN: as jax and all printers convert."""
    limits = np.iinfo(np.int32)
    return np.clip(np.nan_to_num(a), limits.min, limits.max).astype(np.int64)


# Operations entry by entry: how they are computed where all arguments are constants.
FOLDS: dict[str, Callable] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "rem": np.fmod,
    "neg": np.negative, "abs": np.abs, "max": np.maximum, "min": np.minimum, "sign": np.sign,
    "floor": np.floor, "ceil": np.ceil, "round": np.rint, "sqrt": np.sqrt, "exp": np.exp,
    "log": np.log, "sin": np.sin, "cos": np.cos, "tanh": np.tanh, "atan": np.arctan,
    "finite": np.isfinite,
    "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "eq": np.equal, "ne": np.not_equal, "and": np.logical_and, "or": np.logical_or,
    "not": np.logical_not, "select": np.where, "int": _to_int, "float": np.float64,
    "bool": np.bool_, "idiv": lambda a, b: np.trunc(a / b).astype(np.int64),
}  # fmt: skip
BOOLEAN = {"lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "finite", "bool"}
# Kinds of nodes by those of numpy.
KINDS = {"f": "float", "i": "int", "u": "int", "b": "bool"}


def _types_of(precision: str) -> dict[str, np.dtype]:
    return {"float": np.dtype(precision), "int": np.dtype("i8"), "bool": np.dtype("?")}


class Builder:
    """Makes nodes: one for equal values, a constant where all arguments are."""

    def __init__(self, precision: str):
        self.types = _types_of(precision)
        self._known: dict[Any, Node] = {}

    def node(self, op: str, args: tuple[Node, ...] = (), kind: str = "float",
             size: int | None = None, value: Any = None) -> Node:  # fmt: skip
        """The node of these fields."""
        said = (value.tobytes(), value.shape) if isinstance(value, np.ndarray) else value
        key = (op, tuple(map(id, args)), kind, size, said)
        if key not in self._known:  # a node is kept, so its id is not given to another
            self._known[key] = Node(op, args, kind, size, value)
        return self._known[key]

    def constant(self, value: Any, kind: str | None = None) -> Node:
        """A number, or a flat array of numbers; ``kind`` None: that of its type."""
        array = np.asarray(value)
        kind = kind or KINDS[array.dtype.kind]
        array = array.astype(self.types[kind])
        return self.node("constant", (), kind, None if array.ndim == 0 else array.size, array)

    def op(self, op: str, *args: Node) -> Node:
        """An operation of ``FOLDS``."""
        kind = "bool" if op in BOOLEAN else args[-1].kind
        kind = {"int": "int", "float": "float", "idiv": "int"}.get(op, kind)
        if op == kind == args[0].kind:
            return args[0]  # a conversion to what it is
        sizes = {arg.size for arg in args} - {None}
        if all(map(is_constant, args)):
            with np.errstate(all="ignore"):
                return self.constant(FOLDS[op](*(arg.value for arg in args)), kind)
        size = sizes.pop() if sizes else None
        same = _simpler(op, args)
        if same is not None and same.size == size:
            return same
        return self.node(op, args, kind, size)

    def item(self, vector: Node, index: int) -> Node:
        """An entry of a vector."""
        if is_constant(vector):
            return self.constant(vector.value[index], vector.kind)
        if vector.op == "pack":
            return vector.args[index]
        return self.node("item", (vector,), vector.kind, None, index)

    def pack(self, scalars: Iterable[Node]) -> Node:
        """The vector of some scalars."""
        args = tuple(scalars)
        if all(map(is_constant, args)):
            return self.constant(np.stack([arg.value for arg in args]), args[0].kind)
        return self.node("pack", args, args[0].kind, len(args))

    def concat(self, vectors: Iterable[Node]) -> Node:
        """Vectors, one after the other."""
        args = tuple(vectors)
        if len(args) == 1:
            return args[0]
        if all(map(is_constant, args)):
            return self.constant(np.concatenate([arg.value for arg in args]), args[0].kind)
        return self.node("concat", args, args[0].kind, sum(arg.size or 0 for arg in args))

    def take(self, vector: Node, index: Node) -> Node:
        """The entries ``index`` of a vector; a scalar for a scalar index. None is outside."""
        if is_constant(vector) and is_constant(index):
            return self.constant(vector.value[index.value], vector.kind)
        if is_constant(index):
            if index.size is None:
                return self.item(vector, int(index.value))
            if np.array_equal(index.value, np.arange(vector.size or 0)):
                return vector
            if vector.op == "take" and is_constant(vector.args[1]):
                inner = vector.args[1].value[index.value]
                return self.take(vector.args[0], self.constant(inner))
        return self.node("take", (vector, index), vector.kind, index.size)

    def matmul(self, a: Node, b: Node, m: int, k: int, n: int) -> Node:
        """(m, k) times (k, n)."""
        if is_constant(a) and is_constant(b):
            return self.constant((a.value.reshape(m, k) @ b.value.reshape(k, n)).ravel())
        return self.node("matmul", (a, b), "float", m * n, (m, k, n))

    def reduce(self, op: str, a: Node, m: int, k: int) -> Node:
        """``total``, ``largest`` or ``smallest`` of the rows of (m, k)."""
        return self.node(op, (a,), a.kind, m, (m, k))

    def sums(self, a: Node, m: int, k: int) -> Node:
        """The running sums of the rows of (m, k), which are as many."""
        return self.node("sums", (a,), a.kind, m * k, (m, k))


def _simpler(op: str, args: tuple[Node, ...]) -> Node | None:
    """An argument that is the result too."""
    a, b = args[0], args[-1]
    if op == "select":
        if args[1] is args[2]:
            return args[1]
        if is_constant(a) and a.size is None:
            return args[1] if a.value else args[2]
    if (op == "add" and is_constant(a, 0)) or (op == "mul" and is_constant(a, 1)):
        return b
    if (op in ("add", "sub") and is_constant(b, 0)) or (op in ("mul", "div") and is_constant(b, 1)):
        return a
    if op in ("and", "or"):
        for this, other in ((a, b), (b, a)):
            if is_constant(this, op == "and"):
                return other
            if is_constant(this, op == "or"):
                return this
    return a if op in ("and", "or", "max", "min") and a is b else None

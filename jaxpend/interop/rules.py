"""The operations of jax that a ``Program`` can express, and how; no other can be exported."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .program import KINDS
from .sums import dot_general, position, reduced, running
from .translate import Array, Translator

__all__ = ["RULES"]

UNROLLED = 16  # a loop of a fixed length that is no longer is written out

Params = dict[str, Any]
Shape = tuple[int, ...]

# Entry by entry, with the same arguments.
SAME = {
    "add": "add", "add_any": "add", "sub": "sub", "mul": "mul", "neg": "neg", "abs": "abs",
    "max": "max", "min": "min", "sign": "sign", "floor": "floor", "ceil": "ceil",
    "sqrt": "sqrt", "exp": "exp", "log": "log", "sin": "sin", "cos": "cos", "tanh": "tanh",
    "atan": "atan", "is_finite": "finite", "lt": "lt", "le": "le", "gt": "gt", "ge": "ge",
    "eq": "eq", "ne": "ne", "lt_to": "lt", "le_to": "le",
}  # fmt: skip
# Jaxprs in a jaxpr, and the parameter that holds them.
CALLS = {
    "jit": "jaxpr", "remat2": "jaxpr", "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr",
}  # fmt: skip
IDENTITIES = ("optimization_barrier", "copy", "stop_gradient")
# The result has entries of the argument, wherever they come from.
MOVES: dict[str, Callable[[np.ndarray, Params], np.ndarray]] = {
    "reshape": lambda a, p: a.reshape(p["new_sizes"]),
    "squeeze": lambda a, p: a.squeeze(tuple(p["dimensions"])),
    "transpose": lambda a, p: a.transpose(p["permutation"]),
    "rev": lambda a, p: np.flip(a, p["dimensions"]),
    "broadcast_in_dim": lambda a, p: _broadcast(a, p["shape"], p["broadcast_dimensions"]),
    "slice": lambda a, p: a[
        tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or [1] * a.ndim))
    ],
}
REDUCTIONS = {
    "reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul",
    "reduce_and": "and", "reduce_or": "or",
}  # fmt: skip
RUNNING = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
# Of truth values; of integers they would be operations on bits.
LOGIC = {"and": "and", "or": "or", "xor": "ne", "not": "not"}
# Where the first entry is that no other is better than, in this sense.
POSITIONS = {"argmax": "gt", "argmin": "lt"}
# Entry by entry, by other operations on the one argument.
COMPOSED: dict[str, Callable[[Translator, Array], Array]] = {
    "square": lambda tr, a: tr.op("mul", a, a),
    "rsqrt": lambda tr, a: tr.op("div", tr.constant(1.0), tr.op("sqrt", a)),
    "expm1": lambda tr, a: tr.op("sub", tr.op("exp", a), tr.constant(1.0)),
    "tan": lambda tr, a: tr.op("div", tr.op("sin", a), tr.op("cos", a)),
}
RULES: dict[str, Callable[[Translator, list[Array], Params, Shape], Any]] = {}


def rule(name: str) -> Callable:
    """Enter a function for the primitive of that name."""

    def enter(function: Callable) -> Callable:
        RULES[name] = function
        return function

    return enter


def _broadcast(a: np.ndarray, shape: Sequence[int], dims: Sequence[int]) -> np.ndarray:
    wide = [1] * len(shape)
    for dim, size in zip(dims, a.shape, strict=True):
        wide[dim] = size
    return np.broadcast_to(a.reshape(wide), shape)


def _same(op: str) -> Callable:
    return lambda tr, args, p, shape: tr.op(op, *args)


def _call(field: str) -> Callable:
    return lambda tr, args, p, shape: _called(tr, p[field], args)


def _moved(how: Callable[[np.ndarray, Params], np.ndarray]) -> Callable:
    return lambda tr, args, p, shape: tr.move(args[0], lambda a: how(a, p))


def _reduction(op: str) -> Callable:
    return lambda tr, args, p, shape: reduced(tr, args[0], op, p["axes"], shape)


def _running(op: str) -> Callable:
    return lambda tr, args, p, shape: running(tr, args[0], op, p["axis"], p["reverse"])


def _logic(op: str) -> Callable:
    def logic(tr, args, p, shape):
        if any(arg.size and arg.kind != "bool" for arg in args):
            raise tr.refuse("it works on the bits of integers")
        return tr.op(op, *args)

    return logic


def _position(better: str) -> Callable:
    return lambda tr, args, p, shape: position(tr, args[0], better, p["axes"], shape)


def _composed(how: Callable[[Translator, Array], Array]) -> Callable:
    return lambda tr, args, p, shape: how(tr, args[0])


RULES |= {name: _same(op) for name, op in SAME.items()}
RULES |= {name: _call(field) for name, field in CALLS.items()}
RULES |= {name: lambda tr, args, p, shape: args for name in IDENTITIES}
RULES |= {name: _moved(how) for name, how in MOVES.items()}
RULES |= {name: _reduction(op) for name, op in REDUCTIONS.items()}
RULES |= {name: _running(op) for name, op in RUNNING.items()}
RULES |= {name: _logic(op) for name, op in LOGIC.items()}
RULES |= {name: _position(better) for name, better in POSITIONS.items()}
RULES |= {name: _composed(how) for name, how in COMPOSED.items()}


def _called(tr: Translator, inner: Any, args: list[Array]) -> list[Array]:
    return tr(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), args)


# Entry by entry


@rule("div")
def _div(tr, args, p, shape):
    return tr.op("idiv" if args[0].kind == "int" else "div", *args)


@rule("rem")
def _rem(tr, args, p, shape):
    a, b = args
    if a.kind != "int":
        return tr.op("rem", a, b)
    return tr.op("sub", a, tr.op("mul", tr.op("idiv", a, b), b))


@rule("integer_pow")
def _integer_pow(tr, args, p, shape):
    power, (a,) = p["y"], args
    if power == 0:
        return tr.each(lambda node: tr.build.constant(1.0), a)
    result, square, left = None, a, abs(power)
    while left:
        if left % 2:
            result = square if result is None else tr.op("mul", result, square)
        left //= 2
        square = tr.op("mul", square, square) if left else square
    return tr.op("div", tr.constant(1.0), result) if power < 0 else result


@rule("logistic")
def _logistic(tr, args, p, shape):
    one = tr.constant(1.0)
    return tr.op("div", one, tr.op("add", one, tr.op("exp", tr.op("neg", args[0]))))


@rule("clamp")
def _clamp(tr, args, p, shape):
    low, a, high = args
    return tr.op("min", tr.op("max", a, low), high)


@rule("round")
def _round(tr, args, p, shape):
    if int(p["rounding_method"]) == 1:  # halves to even, as in IEEE 754
        return tr.op("round", args[0])
    up = tr.op("floor", tr.op("add", tr.op("abs", args[0]), tr.constant(0.5)))
    return tr.op("mul", tr.op("sign", args[0]), up)


@rule("convert_element_type")
def _convert(tr, args, p, shape):
    dtype = np.dtype(p["new_dtype"])
    if dtype.kind not in KINDS:
        raise tr.refuse(f"it uses numbers of the type {dtype}")
    return tr.op(KINDS[dtype.kind], args[0])


@rule("select_n")
def _select_n(tr, args, p, shape):
    which, *cases = args
    if which.kind == "bool":
        return tr.op("select", which, cases[1], cases[0])
    result = cases[0]
    for number, case in enumerate(cases[1:], 1):
        result = tr.op("select", tr.op("ge", which, tr.constant(number)), case, result)
    return result


# Moving numbers about


@rule("iota")
def _iota(tr, args, p, shape):
    wide = [1] * len(shape)
    wide[p["dimension"]] = -1
    entries = np.arange(shape[p["dimension"]], dtype=p["dtype"]).reshape(wide)
    return tr.constant(np.broadcast_to(entries, shape))


@rule("concatenate")
def _concatenate(tr, args, p, shape):
    return tr.join(args, lambda parts: np.concatenate(parts, p["dimension"]))


@rule("stack")
def _stack(tr, args, p, shape):
    return tr.join(args, lambda parts: np.stack(parts, p["axis"]))


@rule("split")
def _split(tr, args, p, shape):
    ends = np.cumsum(p["sizes"])[:-1]
    count = range(len(p["sizes"]))
    return [tr.move(args[0], lambda a, i=i: np.split(a, ends, p["axis"])[i]) for i in count]


@rule("pad")
def _pad(tr, args, p, shape):
    config = p["padding_config"]

    def padded(parts):
        a, value = parts
        size = [n + max(n - 1, 0) * inner for n, (_, _, inner) in zip(a.shape, config, strict=True)]
        wide = np.full(size, value, a.dtype)
        wide[tuple(slice(None, None, inner + 1) for _, _, inner in config)] = a
        wide = np.pad(wide, [(max(low, 0), max(high, 0)) for low, high, _ in config],
                      constant_values=value)  # fmt: skip
        cut = [slice(max(-low, 0), n - max(-high, 0))
               for n, (low, high, _) in zip(wide.shape, config, strict=True)]  # fmt: skip
        return wide[tuple(cut)]

    return tr.join(args, padded)


@rule("dynamic_slice")
def _dynamic_slice(tr, args, p, shape):
    operand, *starts = args
    starts = [tr.move(start, lambda a: np.broadcast_to(a, shape)) for start in starts]
    within = _offsets(operand.shape, p["slice_sizes"]).reshape(shape)
    return _looked_up(tr, operand, range(len(starts)), starts, p["slice_sizes"], within)


@rule("gather")
def _gather(tr, args, p, shape):
    operand, indices = args
    numbers, sizes = p["dimension_numbers"], p["slice_sizes"]
    if numbers.operand_batching_dims:
        raise tr.refuse("it looks numbers up in a batch of arrays")
    axes = numbers.start_index_map
    starts = [tr.move(indices, lambda a, i=i: a[..., i]) for i in range(len(axes))]
    # As axes of the result: those of the indices, and those of the slice that stay.
    batch = [axis for axis in range(len(shape)) if axis not in numbers.offset_dims]
    starts = [tr.move(start, lambda a: _broadcast(a, shape, batch)) for start in starts]
    kept = [size for a, size in enumerate(sizes) if a not in numbers.collapsed_slice_dims]
    within = _offsets(operand.shape, sizes).reshape(kept)
    within = _broadcast(within, shape, numbers.offset_dims)
    found = _looked_up(tr, operand, axes, starts, sizes, within)
    if "FILL" not in str(p["mode"]):
        return found
    inside = tr.constant(True)
    for axis, start in zip(axes, starts, strict=True):
        last = tr.constant(operand.shape[axis] - sizes[axis])
        inside = tr.op("and", inside, tr.op("ge", start, tr.constant(0)))
        inside = tr.op("and", inside, tr.op("le", start, last))
    outside = {"float": np.nan, "int": np.iinfo(np.int32).min, "bool": True}[operand.kind]
    fill = tr.constant(outside if p["fill_value"] is None else p["fill_value"])
    return tr.op("select", inside, found, fill)


def _offsets(shape: Shape, sizes: Sequence[int]) -> np.ndarray:
    """Where the entries of a slice are in a flat array of that shape, from its first one on."""
    numbers = np.arange(int(np.prod(shape))).reshape(shape)
    return numbers[tuple(map(slice, sizes))]


def _looked_up(tr, operand, axes, starts, sizes, within) -> Array:
    """The entries ``within`` of slices that begin at ``starts`` along ``axes``, moved inside."""
    place = tr.constant(within)
    for axis, start in zip(axes, starts, strict=True):
        last = tr.constant(operand.shape[axis] - sizes[axis])
        start = tr.op("min", tr.op("max", start, tr.constant(0)), last)
        stride = tr.constant(int(np.prod(operand.shape[axis + 1 :])))
        place = tr.op("add", place, tr.op("mul", start, stride))
    vector = tr.vector(operand)
    if place.small:
        return tr.each(lambda index: tr.build.take(vector, index), place)
    return Array(place.shape, tr.build.take(vector, tr.vector(place)))


# Sums and products


@rule("dot_general")
def _dot_general(tr, args, p, shape):
    return dot_general(tr, args, p["dimension_numbers"], shape)


# Control


@rule("cond")
def _cond(tr, args, p, shape):
    """All branches, and the results of one: no step is shorter than the longest."""
    which, *operands = args
    cases = [_called(tr, branch, operands) for branch in p["branches"]]
    if len(cases) == 2 and which.kind == "int":
        which = tr.op("bool", which)
    return [_select_n(tr, [which, *results], p, shape) for results in zip(*cases, strict=True)]


@rule("scan")
def _scan(tr, args, p, shape):
    length, first, carried = p["length"], p["num_consts"], p["num_carry"]
    if length > UNROLLED:
        raise tr.refuse(f"a step of it loops {length} times; up to {UNROLLED} can be written out")
    consts, carry = args[:first], args[first : first + carried]
    outputs: list[list[Array]] = []
    for i in reversed(range(length)) if p["reverse"] else range(length):
        now = [tr.move(x, lambda a, i=i: a[i, ...]) for x in args[first + carried :]]
        found = _called(tr, p["jaxpr"], [*consts, *carry, *now])
        carry = found[:carried]
        outputs.append(found[carried:])
    if p["reverse"]:
        outputs.reverse()
    stacked = [tr.join(parts, np.stack) for parts in zip(*outputs, strict=True)]
    if not length:
        stacked = [tr.constant(np.zeros((0, *a.shape))) for a in p["jaxpr"].out_avals[carried:]]
    return [*carry, *stacked]

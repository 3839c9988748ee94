"""Sums, products and searches in arrays, for ``rules``: of scalars where they are few."""

from collections.abc import Sequence

import numpy as np

from .translate import SMALL, Array, Translator

__all__ = ["dot_general", "position", "reduced", "running"]

PART = 64  # entries of a vector that is taken apart for an operation that vectors do not have
OF_ROWS = {"add": "total", "max": "largest", "min": "smallest"}
# What an operation makes of no number at all.
NONE = {"add": 0.0, "mul": 1.0, "max": -np.inf, "min": np.inf, "and": True, "or": False}
Shape = tuple[int, ...]


def dot_general(tr: Translator, args: list[Array], dimensions: tuple, shape: Shape) -> Array:
    """The product of two arrays, with the dimension numbers of jax."""
    (left, right), (left_batch, right_batch) = dimensions
    a, b = args
    free_a = [i for i in range(len(a.shape)) if i not in (*left, *left_batch)]
    free_b = [i for i in range(len(b.shape)) if i not in (*right, *right_batch)]
    k = int(np.prod([a.shape[i] for i in left]))
    m = int(np.prod([a.shape[i] for i in free_a]))
    n = int(np.prod([b.shape[i] for i in free_b]))
    batches = int(np.prod([a.shape[i] for i in left_batch]))
    form_a, form_b = (*left_batch, *free_a, *left), (*right_batch, *right, *free_b)
    a = tr.move(a, lambda v: v.transpose(form_a).reshape(batches, m, k))
    b = tr.move(b, lambda v: v.transpose(form_b).reshape(batches, k, n))
    products = []
    for i in range(batches):
        pair = [tr.move(factor, lambda v, i=i: v[i]) for factor in (a, b)]  # type: ignore[misc]
        products.append(_product(tr, pair[0], pair[1], (m, k, n)))
    return tr.join(products, lambda parts: np.concatenate(parts).reshape(shape))


def _product(tr: Translator, a: Array, b: Array, sizes: tuple[int, int, int]) -> Array:
    """(m, k) times (k, n), flat: (m n,)."""
    m, k, n = sizes
    if not k:
        return tr.constant(np.zeros(m * n))
    if not (a.small and b.small and m * n <= SMALL):
        return tr.made(tr.build.matmul(tr.vector(a), tr.vector(b), m, k, n), (m * n,))
    rows, columns = a.content, b.content.T
    entries = [
        tr.chain("add", [tr.build.op("mul", x, y) for x, y in zip(row, column, strict=True)])
        for row in rows
        for column in columns
    ]
    return Array.of_scalars(entries, (m * n,))


def reduced(tr: Translator, a: Array, op: str, axes: Sequence[int], shape: Shape) -> Array:
    """The entries along some axes combined by an operation of two arguments, such as ``add``."""
    kept = [axis for axis in range(len(a.shape)) if axis not in axes]
    k = int(np.prod([a.shape[axis] for axis in axes]))
    m = int(np.prod([a.shape[axis] for axis in kept]))
    if not k:
        return tr.constant(np.full(shape, NONE[op]))
    rows = tr.move(a, lambda v: v.transpose((*kept, *axes)).reshape(m, k))
    if op in OF_ROWS and not rows.small:
        return tr.made(tr.build.reduce(OF_ROWS[op], tr.vector(rows), m, k), shape)
    return Array.of_scalars([tr.chain(op, row) for row in _taken_apart(tr, rows)], shape)


def _taken_apart(tr: Translator, a: Array) -> np.ndarray:
    """Its scalars. Raises ``JaxpendError`` if they are too many to be written one by one."""
    if a.size > PART and not a.small:
        raise tr.refuse(f"it looks for one of {a.size} numbers, or sums them step by step")
    return tr.scalars(a)


def position(tr: Translator, a: Array, better: str, axes: Sequence[int], shape: Shape) -> Array:
    """Where along an axis the first largest (``better`` is "gt") or smallest ("lt") entry is."""
    rows = tr.move(a, lambda v: np.moveaxis(v, axes[0], -1).reshape(-1, v.shape[axes[0]]))
    found = []
    for row in _taken_apart(tr, rows):
        best, place = row[0], tr.build.constant(0)
        for number, entry in enumerate(row[1:], 1):
            this = tr.build.op(better, entry, best)
            best = tr.build.op("select", this, entry, best)
            place = tr.build.op("select", this, tr.build.constant(number), place)
        found.append(place)
    return Array.of_scalars(found, shape)


def running(tr: Translator, a: Array, op: str, axis: int, reverse: bool) -> Array:
    """As ``reduced`` along one axis, with all that comes before the result: a cumulative sum."""
    if op == "add" and not a.small:
        turned = tr.move(a, lambda v: np.moveaxis(np.flip(v, axis) if reverse else v, axis, -1))
        k = turned.shape[-1]
        node = tr.build.sums(tr.vector(turned), a.size // max(k, 1), k)
        back = tr.move(Array(turned.shape, node), lambda v: np.moveaxis(v, -1, axis))
        return tr.move(back, lambda v: np.flip(v, axis)) if reverse else back
    lines = np.moveaxis(_taken_apart(tr, a), axis, -1)
    found = np.empty(lines.shape, object)
    for line in np.ndindex(lines.shape[:-1]):
        entries = lines[line][::-1] if reverse else lines[line]
        sums = [tr.chain(op, list(entries[: i + 1])) for i in range(len(entries))]
        found[line] = sums[::-1] if reverse else sums
    return Array(a.shape, np.moveaxis(found, -1, axis))

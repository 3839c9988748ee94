"""Rows that have nothing to do with each other, computed on several devices at once.

JAX's own sharding does all of it: ``together`` puts a mesh of one axis around a computation, and
``split`` lets each device of it compute a share of the rows. What a row gives does not depend on
how many devices there are, up to rounding.
"""

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from . import hosts
from .errors import JaxpendError

__all__ = ["asked", "compute", "everywhere", "pieces", "split", "spread", "together", "use"]

AXIS = "rows"
_asked = 0


def use(count: int) -> None:
    """How many devices to use from now on, the first of those of each host; 0: all of them.

    Raises ``JaxpendError`` where there are not so many.
    """
    global _asked
    there = jax.local_device_count()
    if count > there:
        text = f"devices is {count}; jax has {there} here"
        if jax.default_backend() == "cpu":
            flag = "--xla_force_host_platform_device_count=N"
            text += f", and XLA_FLAGS={flag} makes N of a processor"
        raise JaxpendError(text)
    _asked = count


def asked() -> bool:
    """Whether ``use`` was told how many."""
    return _asked > 0


def _mesh() -> Mesh | None:
    """The devices in use, if they are several."""
    each = [jax.local_devices(process_index=host) for host in range(jax.process_count())]
    devices = [device for own in each for device in own[: _asked or None]]
    if len(devices) == 1:
        return None
    return jax.make_mesh((len(devices),), (AXIS,), (AxisType.Auto,), devices=devices)


def _call_python(arguments: Any) -> bool:
    """Whether a controller among them is a ``PythonLaw``, or is made with one."""

    def calls(node: Any) -> bool:
        return getattr(node, "calls_python", False)

    return any(map(calls, jax.tree.leaves(arguments, is_leaf=calls)))


def _shares() -> int:
    """Among how many devices rows can be shared here; 1 within a share."""
    mesh = jax.sharding.get_abstract_mesh()
    return mesh.shape[AXIS] if AXIS in mesh.auto_axes else 1


@contextlib.contextmanager
def together(*arguments: Any) -> Iterator[None]:
    """Inside, a compiled function runs on all devices in use: see ``split``.

    Not if one of its arguments calls Python, which has one state at a time.
    """
    mesh = None if _call_python(arguments) else _mesh()
    if mesh is None:
        yield
        return
    with jax.set_mesh(mesh):
        yield


def compute(function: Callable[..., Any], *args: Any, **static: Any) -> Any:
    """What a function of arrays gives on all devices in use; it lies on the first one then.

    Every computation around it stays on one device. ``static`` are arguments that hold no arrays.

    Raises:
        JaxpendError: another host is gone.
    """
    if _mesh() is None:
        return function(*args, **static)
    here = jax.local_devices()[0]
    with hosts.guarded():
        with together(*args):
            found = function(*everywhere(args), **static)
        if jax.process_count() == 1:
            return jax.device_put(found, here)
        own = jax.tree.map(lambda leaf: leaf.addressable_data(0), found)
        return jax.block_until_ready(jax.device_put(own, here))


def everywhere(tree: Any) -> Any:
    """Arrays, of which each device has a copy where ``together`` is in force."""
    mesh = jax.sharding.get_mesh()
    if mesh.empty:
        return tree
    copied = NamedSharding(mesh, PartitionSpec())
    if jax.process_count() == 1:
        return jax.device_put(tree, copied)

    def put(leaf: Any) -> jax.Array:
        """Of an array that all hosts have alike; nothing is sent."""
        leaf = leaf if isinstance(leaf, jax.Array) else np.asarray(leaf)
        own = [jax.device_put(leaf, device) for device in mesh.local_devices]
        return jax.make_array_from_single_device_arrays(own[0].shape, copied, own)

    return jax.tree.map(put, tree)


def split(function: Callable[..., Any], *same: Any) -> Callable[..., Any]:
    """A function of rows, of which each device computes its share where ``together`` is in force.

    ``function`` takes ``same``, pytrees of arrays that all rows have in common, and then pytrees of
    arrays (n, ...); it gives pytrees of arrays (n, ...), and treats every row alone, as one made by
    ``jax.vmap`` does. It must not close over traced values, which are for ``same``: jax refuses
    operations such as ``zeros_like`` on them. Where the devices do not divide n, the last row is
    computed several times.
    """
    size = _shares()
    if size == 1:
        return partial(function, *same)

    def shared(*rows: Any) -> Any:
        n = len(jax.tree.leaves(rows)[0])
        index = jnp.minimum(jnp.arange(-(-n // size) * size), n - 1)
        # Every device makes all rows, so that none sends any to another.
        rows = jax.lax.with_sharding_constraint(rows, PartitionSpec())
        filled = jax.tree.map(lambda leaf: leaf[index], rows) if n % size else rows
        by_row = PartitionSpec(AXIS)
        specs = (PartitionSpec(),) * len(same) + (by_row,) * len(filled)
        share = jax.shard_map(function, in_specs=specs, out_specs=by_row, check_vma=False)
        found = jax.tree.map(lambda leaf: leaf[:n], share(*same, *filled))
        return jax.lax.with_sharding_constraint(found, PartitionSpec())

    return shared


def pieces(count: int, most: int) -> Iterator[np.ndarray]:
    """The numbers of rows in pieces of at most ``most``, for a loop over one compiled program.

    All are as long as the first: the last one is filled up with copies of the last row.
    """
    size = min(most, count)
    for first in range(0, count, size):
        yield np.minimum(np.arange(first, first + size), count - 1)


def spread(tree: Any, axis: int = 0) -> Any:
    """Arrays of which each device holds a share along an axis, where that can be divided.

    What is computed of them is then shared as well; XLA adds what the devices have to exchange.
    """
    size = _shares()
    if size == 1 or any(leaf.shape[axis] % size for leaf in jax.tree.leaves(tree)):
        return tree
    return jax.lax.with_sharding_constraint(tree, PartitionSpec(*[None] * axis, AXIS))

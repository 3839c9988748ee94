"""From a controller to a ``Program``: jax traces one step, and its operations are translated."""

import jax
import jax.numpy as jnp
import numpy as np

from ..controller import Controller, check_controller
from ..controllers.policy import change_policies
from ..errors import THEIRS, JaxpendError, blame, choose
from ..pytree import in_default
from .program import KINDS, Builder, Leaf, Node, Program
from .rules import RULES
from .translate import SMALL, Array, Translator

__all__ = ["trace"]

PRECISIONS = ("float32", "float64")
MOST = 20_000  # nodes; a guarded policy has about 700


def trace(controller: Controller, precision: str) -> Program:
    """One step of a controller, traced.

    Policies are exported without their ``action_noise``: that is for training, and a program has
    no random numbers. Memory is that of ``reset(jax.random.key(0))``.

    Args:
        controller: of any class; its arrays are converted to ``precision``.
        precision: "float32" or "float64".

    Raises:
        JaxpendError: an unknown precision, what is no controller, or one that loops, draws random
            numbers, calls Python or uses another operation that cannot be printed.
    """
    choose("precision", precision, PRECISIONS)
    check_controller(controller)
    controller, _ = change_policies(controller, lambda policy: policy.replace(action_noise=None))
    name = type(controller).__name__
    with jax.enable_x64(precision == "float64"):
        controller = in_default(controller)
        carry = controller.reset(jax.random.key(0))
        paths, structure = jax.tree_util.tree_flatten_with_path(carry)
        leaves = [jnp.asarray(leaf) for _, leaf in paths]
        if any(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in leaves):
            raise JaxpendError(f"{name} cannot be exported: it draws random numbers")
        carry = jax.tree.unflatten(structure, leaves)
        inputs = (carry, jnp.zeros((), precision), jnp.zeros(4, precision))
        try:
            # Its arrays are no inputs here, but constants.
            closed = jax.make_jaxpr(lambda carry, t, x: controller(carry, t, x))(*inputs)
        except THEIRS as error:
            text = f"{name} cannot be exported: it cannot be called in {precision}: {blame(error)}"
            raise JaxpendError(text) from error
        initial = [np.asarray(leaf) for leaf in leaves]
    if empty := [path for (path, _), value in zip(paths, initial, strict=True) if not value.size]:
        where = f"its memory{jax.tree_util.keystr(empty[0])} has no entries; leave it out"
        raise JaxpendError(f"{name} cannot be exported: {where}")
    builder = Builder(precision)
    translate = Translator(builder, name, RULES)
    state = [
        Leaf(
            jax.tree_util.keystr(path), KINDS[value.dtype.kind], value.ravel(), value.size <= SMALL
        )
        for (path, _), value in zip(paths, initial, strict=True)
    ]
    given = [_variable(builder, n, leaf, initial[n].shape) for n, leaf in enumerate(state)]
    t = Array.of_scalars([builder.node("t")])
    x = Array.of_scalars([builder.node("x", value=i) for i in range(4)], (4,))
    *after, torque = translate(closed.jaxpr, closed.consts, [*given, t, x])
    pairs = zip(after, state, strict=True)
    next_state = tuple(_output(translate, array, leaf.kind, leaf.scalar) for array, leaf in pairs)
    tau1, tau2 = _output(translate, torque, "float", True)
    program = Program(name, precision, tuple(state), next_state, (tau1, tau2))
    if len(program.nodes) > MOST:
        raise JaxpendError(
            f"{name} cannot be exported: a step of it has {len(program.nodes)} operations, and at "
            f"most {MOST} can be written one by one"
        )
    return program


def _variable(builder: Builder, number: int, leaf: Leaf, shape: tuple[int, ...]) -> Array:
    """The leaf of that number as an input."""
    size = leaf.initial.size
    if not leaf.scalar:
        return Array(shape, builder.node("state", (), leaf.kind, size, (number, None)))
    entries = [builder.node("state", (), leaf.kind, None, (number, i)) for i in range(size)]
    return Array.of_scalars(entries, shape)


def _output(translate: Translator, array: Array, kind: str, scalar: bool) -> tuple[Node, ...]:
    """Its entries, or one vector, of the kind that is wanted."""
    parts = translate.scalars(array).ravel() if scalar else [translate.vector(array)]
    return tuple(translate.build.op(kind, part) for part in parts)

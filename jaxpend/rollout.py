"""The closed loop: one ``lax.scan`` of a controller on a scenario. Nothing else simulates."""

import sys
import types
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .controller import Controller, check_form
from .errors import JaxpendError
from .plant import Plant, rk4_step
from .pytree import Pytree, pytree
from .resets import begun, push
from .scenario import DT, DURATION, Scenario, check_values
from .stepping import called_every

__all__ = [
    "SLOTS", "Sensors", "Trajectory", "actuate", "draws", "final_state", "measure", "rollout",
    "sensors", "time_stamps",
]  # fmt: skip

SLOTS = 32  # past states kept for delayed measurements, by default
# Columns of the standard normals of one step, in the order of the reference simulator.
NOISE = {"measurement_noise": (0, 4), "torque_noise": (4, 6), "process_noise": (6, 10)}


@pytree
class Trajectory(Pytree):
    """One closed-loop run of N steps. A leading batch axis comes from ``jax.vmap``."""

    t: jax.Array  # (N + 1,) s
    x: jax.Array  # (N + 1, 4) true state
    u: jax.Array  # (N, 2) N m, applied over [t[k], t[k + 1]]
    x_measured: jax.Array  # (N, 4) what the controller saw
    u_command: jax.Array  # (N, 2) N m, what the controller asked for


def time_stamps(dt: float, duration: float) -> np.ndarray:
    """Time stamps of the reference simulator: the running float64 sum of ``dt``, (N + 1,), s.

    It steps while ``t < duration``: 10 s at 0.002 s are 5000 steps, the last stamp being
    10.000000000000009. Raises ``JaxpendError`` unless both are positive and finite.
    """
    if not (0 < dt < np.inf and 0 < duration < np.inf):
        raise JaxpendError(f"dt = {dt} s and duration = {duration} s must be positive and finite")
    t = np.concatenate([[0.0], np.cumsum(np.full(int(duration / dt) + 2, dt))])
    return t[: int(np.argmax(t >= duration)) + 1]


def draws(scenario: Scenario, key, normals, steps: int, dtype) -> dict[str, jax.Array]:
    """Standard normals (steps, columns) of each noise that the scenario has, and of no other.

    Of a jitter of the delay they are numbers (steps,) in [0, 1). Drawn for all steps at once: a
    draw in every step cost more than the physics.
    """
    noisy = [name for name in NOISE if getattr(scenario, name) is not None]
    *noise_keys, jitter_key = jax.random.split(key, len(NOISE) + 1)
    found = {}
    if scenario.delay_jitter is not None:
        found["delay_jitter"] = jax.random.uniform(jitter_key, (steps,), dtype)
    if normals is not None:
        if (shape := jnp.shape(normals)) != (steps, 10):
            raise JaxpendError(f"normals have shape {shape}; they must be ({steps}, 10)")
        return found | {n: jnp.asarray(normals, dtype)[:, slice(*NOISE[n])] for n in noisy}
    for (name, (first, end)), noise_key in zip(NOISE.items(), noise_keys, strict=True):
        if name in noisy:
            found[name] = jax.random.normal(noise_key, (steps, end - first), dtype)
    return found


@pytree
class Sensors(Pytree):
    """What the sensors of a scenario remember."""

    # (slots, 4) what they read, a ring buffer, where there is a delay.
    states: jax.Array | None
    encoded: jax.Array | None  # (4,) the last angles and velocities of an encoder


def sensors(scenario: Scenario, x0: jax.Array, slots: int) -> Sensors:
    """They before a run from ``x0`` (4,), with room for ``slots`` delayed states."""
    lags = scenario.delay is not None or scenario.delay_jitter is not None
    states = jnp.broadcast_to(x0, (slots, 4)) if lags else None
    return Sensors(states, None if scenario.encoder is None else x0)


def measure(scenario: Scenario, sensors: Sensors, k, x, z, dt):
    """Delayed and noisy measurement, as an encoder gives it; with the sensors after it.

    What an encoder reads is delayed on its way; its noise of angles is in front of it, that of
    velocities behind its filter. Without one the noise is behind the delay, as in the reference
    simulator. ``dt`` is the time from one measurement to the next, s.
    """
    sigma, seen, encoded, states = scenario.measurement_noise, x, None, sensors.states
    noise = None if sigma is None else sigma * z["measurement_noise"]
    if (encoder := scenario.encoder) is not None:
        before = sensors.encoded
        assert before is not None
        angles = x[:2] if noise is None else x[:2] + noise[:2]
        angles = encoder.step * jnp.round(angles / encoder.step)
        rate = jnp.where(k == 0, before[2:], (angles - before[:2]) / dt)
        filtered = before[2:] + dt / (dt + encoder.filtered) * (rate - before[2:])
        encoded = jnp.concatenate([angles, filtered])
        seen = encoded if noise is None else encoded.at[2:].add(noise[2:])
    if states is not None:
        slots = states.shape[0]
        states = jax.lax.dynamic_update_slice_in_dim(states, seen[None], k % slots, 0)
        delay = np.zeros(4, "i4") if scenario.delay is None else scenario.delay
        if scenario.delay_jitter is not None:
            most = scenario.delay_jitter + 1
            delay = delay + jnp.floor(z["delay_jitter"] * most).astype(jnp.int32)
        lagged = jnp.maximum(k - delay, 0) % slots
        seen = jnp.take_along_axis(states, lagged[None], axis=0)[0]
    if encoder is None and noise is not None:
        seen = seen + noise
    return Sensors(states, encoded), seen


def actuate(scenario: Scenario, command, applied_before, t_pulse, z, measured):
    """Torque that reaches the joints: response, noise, limit, disturbance, in this order.

    A compensation of friction, by what is ``measured`` (4,), comes behind the limit.
    """
    limit, torques = scenario.plant.torque_limit, []
    for joint in range(2):  # apart from each other, as in ``plant.joint_torque``
        u = command[joint]
        if scenario.responsiveness is not None:
            u = applied_before[joint] + scenario.responsiveness * (u - applied_before[joint])
        if scenario.torque_noise is not None:
            u = u + scenario.torque_noise[joint] * z["torque_noise"][joint]
        torques.append(jnp.clip(u, -limit[joint], limit[joint]))
    u = jnp.stack(torques)
    if scenario.compensation is not None:
        u = u + scenario.compensation.torque(measured)
    return u if scenario.pulses is None else u + scenario.pulses.torque(t_pulse)


def _closed_loop(
    scenario, controller, key, dt, duration, integrator, delay_slots, normals=None, record=False
):
    """``rollout`` without checks; only the last state unless ``record``."""
    stamps = time_stamps(dt, duration)
    steps = len(stamps) - 1
    dtype = scenario.dtype
    plant = scenario.plant
    x0 = jnp.zeros(4, dtype) if scenario.x0 is None else jnp.asarray(scenario.x0, dtype)
    noise_key, controller_key = jax.random.split(key)
    # The reference looks disturbances up at int(t / dt) of its drifting float time.
    inputs = {
        "k": np.arange(steps),
        "t": stamps[:-1].astype(dtype),
        "t_pulse": ((stamps[:-1] / dt).astype(int) * dt).astype(dtype),
        "z": draws(scenario, noise_key, normals, steps, dtype),
    }

    def step(carry, now):
        parts, u, memory, hand, sensed = carry
        x = jnp.stack(parts)
        sensed, measured = measure(scenario, sensed, now["k"], x, now["z"], dt)
        seen = measured
        if scenario.resets is not None:
            holds, hand, torque = push(scenario.resets, hand, plant, now["k"], measured)
            # Not a number: what a callback remembers, which is not in ``memory``, stays too.
            seen = jnp.where(holds, jnp.nan, measured)
        after, command = controller(memory, now["t"], seen)
        command = jnp.asarray(command, dtype)
        if command.shape != (2,):
            name = type(controller).__name__
            raise JaxpendError(f"{name} returns a torque of shape {command.shape}; it must be (2,)")
        if scenario.resets is not None:  # to the controller it is as if time had jumped
            command = jnp.where(holds, torque, command)
            after = jax.tree.map(lambda old, new: jnp.where(holds, old, new), memory, after)
        u = actuate(scenario, command, u, now["t_pulse"], now["z"], measured)
        x_next = integrator(plant, x, u, dt)
        if scenario.process_noise is not None:
            x_next = x_next + scenario.process_noise * now["z"]["process_noise"]
        carry = tuple(x_next), u, after, hand, sensed
        return carry, (x, u, measured, command) if record else None

    sensed = sensors(scenario, x0, delay_slots)
    hand = None if scenario.resets is None else begun(dtype)
    # The entries of the state are apart, as in ``rk4_step``.
    start = (tuple(x0), jnp.zeros(2, dtype), controller.reset(controller_key), hand, sensed)
    (parts, *_), recorded = jax.lax.scan(step, start, inputs)
    x_end = jnp.stack(parts)
    if not record:
        return x_end
    x, u, measured, command = recorded
    x = jnp.concatenate([x, x_end[None]])
    return Trajectory(jnp.asarray(stamps.astype(dtype)), x, u, measured, command)


def _check_types(*parts: Any) -> None:
    """Refuse arrays of a precision that jax does not compute in any more."""
    if jnp.result_type(float) == jnp.float64:
        return
    for leaf in jax.tree.leaves(parts):
        if isinstance(leaf, jax.Array) and leaf.dtype in (jnp.float64, jnp.int64):
            text = "the scenario or controller was made with jax_enable_x64 on, and it is off now"
            raise JaxpendError(f"{text}; make both again, or leave it on")


def _check(
    scenario: Scenario | Plant, controller: Controller, dt: float, delay_slots: int
) -> tuple[Scenario, Controller]:
    check_form(controller)
    scenario = Scenario(scenario) if isinstance(scenario, Plant) else scenario
    if not isinstance(scenario, Scenario):
        raise JaxpendError(f"{scenario!r:.40} is no scenario; give a Scenario or a Plant")
    check_values(scenario)
    _check_types(scenario, controller)
    if scenario.x0 is not None and (shape := jnp.shape(scenario.x0)) != (4,):
        text = f"x0 has shape {shape}; one rollout starts from (4,): vmap over batches of scenarios"
        raise JaxpendError(text)
    if (longest := scenario.longest_delay) >= delay_slots:
        raise JaxpendError(
            f"a delay of {longest} steps does not fit in a buffer of {delay_slots} states; "
            f"pass delay_slots={longest + 1} or more"
        )
    return scenario, called_every(controller, dt)


def rollout(
    scenario: Scenario | Plant,
    controller: Controller,
    key: jax.Array,
    *,
    dt: float = DT,
    duration: float = DURATION,
    integrator: Callable = rk4_step,
    delay_slots: int = SLOTS,
    normals: jax.Array | None = None,
) -> Trajectory:
    """Run a controller on a scenario; the order of a step is that of the reference simulator.

    Pure: jit it, vmap it over scenarios, controllers and keys. A delay that is traced cannot be
    checked against the buffer: give ``delay_slots`` more than the longest delay in steps.

    Args:
        scenario: one scenario, or a plant for the nominal one.
        controller: any ``Controller``; it is called once a step, zero-order hold.
        key: split once, for the scenario's noise and for ``controller.reset``.
        dt: s, control and integration period.
        duration: s.
        integrator: ``rk4_step`` or ``euler_step``, or any function of the same form.
        delay_slots: past states kept for delayed measurements.
        normals: (N, 10) standard normals to use instead of drawing them: 4 measurement,
            2 torque, 4 process.

    Raises:
        JaxpendError: dt or duration not positive, values that mean nothing (see
            ``check_values``), a delay longer than the buffer, what is no scenario or no
            controller, normals or a torque of another shape, or arrays of a precision that is
            off now.
    """
    scenario, controller = _check(scenario, controller, dt, delay_slots)
    options = (dt, duration, integrator, delay_slots)
    return _closed_loop(scenario, controller, key, *options, normals, record=True)


_final_state = jax.jit(
    _closed_loop, static_argnames=("dt", "duration", "integrator", "delay_slots")
)


def final_state(
    scenario: Scenario | Plant,
    controller: Controller,
    key: jax.Array,
    *,
    dt: float = DT,
    duration: float = DURATION,
    integrator: Callable = rk4_step,
    delay_slots: int = SLOTS,
) -> jax.Array:
    """Only the last true state of ``rollout``, shape (4,): no trajectory is kept in memory.

    Raises ``JaxpendError`` as ``rollout``.
    """
    scenario, controller = _check(scenario, controller, dt, delay_slots)
    return _final_state(scenario, controller, key, dt, duration, integrator, delay_slots)


class _Rollout(types.ModuleType):
    """This module can be called: ``jaxpend.rollout`` is the function and the module at once."""

    def __call__(self, *args: Any, **kwargs: Any) -> Trajectory:
        return rollout(*args, **kwargs)


sys.modules[__name__].__class__ = _Rollout

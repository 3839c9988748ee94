"""The closed loop: the reference's runs, and what must hold for every controller."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, both_robots, excerpt, plant_from, refused
from hypothesis import given
from hypothesis import strategies as st

from jaxpend import Pulses, Scenario, final_state, rollout
from jaxpend.boards import v2
from jaxpend.controller import Memoryless
from jaxpend.controllers import Feedback, OpenLoop, Zero
from jaxpend.designs import active_joint, competition
from jaxpend.plant import euler_step, rk4_step
from jaxpend.pytree import pytree
from jaxpend.rollout import time_stamps
from jaxpend.scenario import delay_steps
from jaxpend.score import criteria, score_v1, score_v2

KEY = jax.random.key(0)
INTEGRATORS = {"runge_kutta": rk4_step, "euler": euler_step}
judge = jax.jit(criteria)
LOOP = ("x", "u", "u_command", "x_measured")


@pytree
class Proportional(Memoryless):
    """``u_a = target - gains . [x_a, omega_a, x_p, omega_p] + sine``, ``u_p = 0``; all data."""

    target: jax.Array  # () N m
    gains: jax.Array  # (4,)
    active: jax.Array  # () int

    def __call__(self, carry, t, x):
        a, p = self.active, 1 - self.active
        seen = jnp.stack([x[a], x[2 + a], x[p], x[2 + p]])
        torque = self.target - jnp.sum(self.gains * seen)
        return carry, jnp.where(jnp.arange(2) == a, torque, 0.0)


@cache
def batched(duration, integrator=rk4_step, with_normals=False):
    """A jitted rollout over batches of scenarios, controllers and (or without) given draws."""

    def one(scenario, controller, normals):
        return rollout(
            scenario, controller, KEY, duration=duration, integrator=integrator, normals=normals
        )

    return jax.jit(jax.vmap(one, (0, 0, 0 if with_normals else None)))


def assert_loop(run, golden, every, cases=slice(None)):
    """The four recorded series of a batch of runs against the thinned ones of an excerpt."""
    for name, recorded in zip(LOOP, ("X", "U", "U_command", "X_meas"), strict=True):
        assert_close(getattr(run, name)[:, ::every], golden[recorded][cases], what=name)


def repeated(value, n):
    """``value`` n times along a new leading axis."""
    return jnp.broadcast_to(jnp.asarray(value), (n, *jnp.shape(value)))


def reference_law(golden, n):
    """The law of the imperfection and noise excerpts, n times."""
    k1, k2, k3, k4 = golden["gains"]
    gains = repeated(jnp.array([k1, k2, k3, k4]), n)
    return Proportional(repeated(k1, n), gains, repeated(int(golden["active_joint"]), n))


def reference_delays(golden):
    """Delays of all cases of an excerpt, (cases, 4) steps."""
    modes = [str(mode).lower() for mode in golden["delay_mode"]]
    delays = zip(golden["delay"], modes, strict=True)
    return jnp.stack([jnp.asarray(delay_steps(d, mode=mode)) for d, mode in delays])


# --- against the reference -----------------------------------------------------------------


def test_time_stamps_are_the_drifting_sums_of_the_reference():
    stamps = time_stamps(0.002, 10.0)
    np.testing.assert_array_equal(stamps, excerpt("trajectories_acrobot")["swing_T"])
    assert stamps[-1] == 10.000000000000009
    assert len(time_stamps(0.002, 2.0)) == 1001
    np.testing.assert_array_equal(time_stamps(0.5, 1.0), [0.0, 0.5, 1.0])


def loop_controller(name, golden, active):
    """The laws of the trajectory excerpt as data; upright enters the LQR's constant part."""
    gains = {"pd": [2.0, 0.15, 0, 0], "free_swing": [0, 0, 0, 0], "const_torque": [0, 0, 0, 0]}
    target = {"pd": 2.0, "free_swing": 0.0, "const_torque": (1.0, 0.4)[active]}
    law = name.split("_")[0] if name.startswith("pd") else name
    if law == "lqr_top":
        k = golden["lqr_K"]
        in_order = [k[active], k[2 + active], k[1 - active], k[3 - active]]
        return Proportional(jnp.array(k[0] * np.pi), jnp.array(in_order), jnp.array(active))
    return Proportional(
        jnp.array(target[law]), jnp.array(gains[law], dtype=float), jnp.array(active)
    )


@pytest.mark.x64
@both_robots
def test_ten_second_closed_loops_and_their_scores(robot):
    g, active = excerpt(f"trajectories_{robot}"), active_joint(robot)
    names = [str(n) for n in g["loop_names"]]
    controllers = [loop_controller(n, g, active) for n in names]
    for integrator, step in INTEGRATORS.items():
        cases = np.flatnonzero(g["loop_integrator"] == integrator)
        params = g["loop_params"][cases]
        plants = plant_from(params, params[:, 15:], g["loop_B"][cases])
        laws = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(controllers[i] for i in cases))
        scenarios = Scenario(plants, x0=jnp.asarray(g["loop_x0"][cases]))
        run = batched(10.0, step)(scenarios, laws, None)
        assert_close(run.x[:, ::100], g["loop_X"][cases])
        judged = judge(run.t, run.x, run.u, competition(robot))
        for name, value in vars(judged).items():
            golden = g[f"loop_metric_{name}"][cases]
            assert_close(jnp.asarray(value, float), golden, what=name)
        assert_close(score_v1(judged), g["loop_score_v1_official"][cases])
        assert_close(score_v2(judged), g["loop_score_v2_official"][cases])
        assert judged.success.any() == (integrator == "runge_kutta")


@pytest.mark.x64
@both_robots
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_delay_responsiveness_limits_and_pulses(robot, integrator):
    g = excerpt(f"imperfections_{robot}")
    cases = np.flatnonzero(g["integrator"] == integrator)
    n = len(cases)
    amplitude = g["uses_perturbation"][cases, None, None] * g["pert_amplitude"]
    scenarios = Scenario(
        plant_from(np.tile(g["params"], (n, 1)), g["torque_limit"][cases], g["B"][cases]),
        x0=repeated(g["x0"], n),
        delay=reference_delays(g)[cases],
        responsiveness=jnp.asarray(g["u_responsiveness"][cases]),
        pulses=Pulses(repeated(g["pert_mu"], n), repeated(g["pert_sigma"], n), amplitude),
    )
    run = batched(2.0, INTEGRATORS[integrator])(scenarios, reference_law(g, n), None)
    assert_loop(run, g, 25, cases)


@pytest.mark.x64
@both_robots
def test_noise_with_the_draws_of_the_reference(robot):
    g = excerpt(f"noise_{robot}")
    n = len(g["names"])
    draws = [
        np.random.RandomState(seed).standard_normal(10000).reshape(1000, 10) for seed in g["seed"]
    ]
    scenarios = Scenario(
        plant_from(np.tile(g["params"], (n, 1)), g["torque_limit"], np.tile(g["B"], (n, 1, 1))),
        x0=repeated(g["x0"], n),
        measurement_noise=jnp.asarray(g["meas_noise_sigma"]),
        delay=reference_delays(g),
        process_noise=jnp.asarray(g["process_noise_sigma"]),
        torque_noise=jnp.asarray(g["u_noise_sigma"]),
        responsiveness=jnp.asarray(g["u_responsiveness"]),
    )
    run = batched(2.0, with_normals=True)(scenarios, reference_law(g, n), np.stack(draws))
    assert_loop(run, g, 25)


@pytest.mark.x64
@both_robots
def test_pulses_follow_the_index_drift_of_the_reference(robot):
    g = excerpt(f"perturbation10s_{robot}")
    assert np.sum(g["perturbation_index"] != np.arange(5000)) == 3979
    plants = plant_from(
        np.tile(g["params"], (2, 1)),
        np.tile(g["torque_limit"], (2, 1)),
        np.stack([g["B_selective"], g["B_full"]]),
    )
    pulses = [repeated(g[f"pert_{name}"], 2) for name in ("mu", "sigma", "amplitude")]
    k1, k2 = g["gains"]
    law = Proportional(
        jnp.zeros(2), repeated(jnp.array([k1, k2, 0, 0]), 2), repeated(active_joint(robot), 2)
    )
    run = batched(10.0)(Scenario(plants, pulses=Pulses(*pulses)), law, None)
    for i, actuation in enumerate(("selectiveB", "fullB")):
        for name, recorded in zip(LOOP, ("X", "U", "U_command"), strict=False):
            value = getattr(run, name)[i, ::25]
            assert_close(value, g[f"{recorded}_{actuation}"], what=f"{name} {actuation}")


# --- what must hold for every rollout ------------------------------------------------------

STEPS = 100
SHORT = STEPS * 0.002


def swing_law(t, x):
    """Something that moves both ways and depends on everything."""
    return jnp.stack([1.5 * jnp.sin(9 * t) - 0.2 * x[2] + x[1], 0.5 - x[1] + 0.1 * x[3]])


SWING = Feedback(swing_law)
NEUTRAL = {
    "measurement_noise": np.zeros(4),
    "delay": np.zeros(4, int),
    "process_noise": np.zeros(4),
    "torque_noise": np.zeros(2),
    "responsiveness": np.array(1.0),
    "pulses": Pulses(np.ones((2, 1)), np.ones((2, 1)), np.zeros((2, 1))),
}
EVERYTHING = {
    "measurement_noise": np.full(4, 0.05),
    "delay": np.array([2, 2, 5, 5]),
    "process_noise": np.full(4, 0.01),
    "torque_noise": np.full(2, 0.3),
    "responsiveness": np.array(0.7),
    "pulses": Pulses(np.full((2, 1), 0.1), np.full((2, 1), 0.03), np.full((2, 1), 2.0)),
}


@jax.jit
def short_run(scenario, controller=SWING, key=KEY):
    """0.2 s, with everything traced."""
    return rollout(scenario, controller, key, duration=SHORT)


@pytest.mark.x64
@pytest.mark.parametrize("name", NEUTRAL)
def test_an_imperfection_of_no_strength_changes_nothing(name):
    plant = competition("acrobot")
    nominal = short_run(Scenario(plant))
    neutral = short_run(Scenario(plant, **{name: NEUTRAL[name]}))
    for series in LOOP:
        assert_close(getattr(neutral, series), getattr(nominal, series), what=series)


@pytest.mark.x64
@pytest.mark.parametrize("name", EVERYTHING)
def test_an_imperfection_of_some_strength_changes_the_run(name):
    plant = competition("acrobot").replace(actuation=jnp.ones(2))
    nominal = short_run(Scenario(plant))
    disturbed = short_run(Scenario(plant, **{name: EVERYTHING[name]}))
    assert jnp.max(jnp.abs(disturbed.x - nominal.x)) > 1e-4


mirrored_final_states = jax.jit(
    jax.vmap(
        lambda x0, sign: rollout(
            Scenario(competition("pendubot"), x0=sign * x0, delay=delay_steps(0.01)),
            Feedback(lambda t, x: jnp.tanh(jnp.stack([2 * x[1] - x[2], x[0]]))),
            KEY,
            duration=SHORT,
        ).x[-1],
        (None, 0),
    )
)


@pytest.mark.x64
@given(st.lists(st.floats(-3, 3), min_size=4, max_size=4))
def test_mirrored_start_gives_the_mirrored_run(x0):
    there, mirrored = mirrored_final_states(jnp.array(x0), jnp.array([1.0, -1.0]))
    assert_close(mirrored, -there)


@pytest.mark.x64
def test_jitted_batched_and_plain_runs_agree():
    plant, steps = competition("pendubot"), 3
    starts = jnp.array([[0.3, -0.2, 1.0, 2.0], [3.0, 0.1, 0.0, -1.0]])
    draws = np.random.default_rng(0).normal(size=(steps, 10))

    def run(x0):
        scenario = Scenario(plant, x0=x0, **EVERYTHING)
        return rollout(scenario, SWING, KEY, duration=steps * 0.002, normals=draws)

    batch = jax.jit(jax.vmap(run))(starts)
    with jax.disable_jit():
        plain = run(starts[1])
    for series in LOOP:
        assert_close(getattr(batch, series)[1], getattr(plain, series), what=series)


def test_final_state_is_the_end_of_the_trajectory():
    scenario = Scenario(competition("acrobot"), **EVERYTHING)
    whole = short_run(scenario).x[-1]
    assert_close(final_state(scenario, SWING, KEY, duration=SHORT), whole)


def test_one_diverged_rollout_does_not_poison_the_others():
    starts = jnp.array([[0.1, 0.0, 0.0, 0.0], [jnp.nan, 0.0, 0.0, 0.0], [0.2, 0.0, 0.0, 0.0]])
    plant = competition("acrobot")

    @jax.jit
    @jax.vmap
    def scored(x0):
        run = rollout(Scenario(plant, x0=x0), SWING, KEY, duration=SHORT)
        return run.x[-1], score_v2(criteria(run.t, run.x, run.u, plant, t_final=SHORT))

    ends, scores = scored(starts)
    alone = short_run(Scenario(plant, x0=starts[0])).x[-1:]
    assert np.isnan(ends[1]).any()
    assert_close(ends[0], alone[0])
    assert np.isfinite(ends[2]).all()
    np.testing.assert_array_equal(np.isfinite(scores), True)
    assert scores[1] == 0


def test_noise_has_the_strength_asked_for_and_comes_from_the_key():
    sigma = np.array([0.1, 0.2, 0.3, 0.4], "f4")
    scenario = Scenario(
        competition("acrobot"), measurement_noise=sigma, torque_noise=np.ones(2, "f4")
    )
    runs = [short_run(scenario, Zero(), jax.random.key(seed)) for seed in (1, 1, 2)]
    noise = [np.asarray(run.x_measured - run.x[:-1]) for run in runs]
    np.testing.assert_array_equal(noise[0], noise[1])
    assert not np.any(noise[0] == noise[2])
    both = np.concatenate([noise[0], noise[2]])
    np.testing.assert_allclose(both.std(axis=0) / sigma, 1.0, atol=0.2)
    np.testing.assert_allclose(both.mean(axis=0) / sigma, 0.0, atol=0.3)
    correlation = np.corrcoef(both.T) - np.eye(4)
    assert np.abs(correlation).max() < 0.3
    # The torque noise is clipped to the limit of each joint: nothing on the passive one.
    assert not np.any(runs[0].u[:, 0])
    np.testing.assert_allclose(np.std(runs[0].u[:, 1]), 1.0, atol=0.3)


@pytree
class Counter:
    """Commands the number of the step, from memory alone."""

    def reset(self, key):
        return jnp.zeros(())

    def __call__(self, carry, t, x):
        return carry + 1, jnp.stack([0 * carry, carry / 100])


def test_memory_is_carried_and_commands_are_held_and_clipped():
    run = short_run(Scenario(competition("acrobot", torque_limit=0.5)), Counter())
    assert_close(run.u_command[:, 1], np.arange(STEPS) / 100)
    assert_close(run.u[:, 1], np.minimum(np.arange(STEPS) / 100, 0.5))


def test_open_loop_holds_each_torque_until_the_next_stamp():
    torques = np.array([[0.0, 1.0], [0.0, -2.0]], "f4")
    law = OpenLoop(jnp.array([0.0, 0.1]), jnp.asarray(torques))
    run = short_run(Scenario(competition("acrobot")), law)
    np.testing.assert_array_equal(run.u_command[:49, 1], 1.0)
    np.testing.assert_array_equal(run.u_command[52:, 1], -2.0)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p: rollout(p, SWING, KEY, dt=0.0), "dt = 0.0 s and duration"),
        (lambda p: rollout(p, SWING, KEY, duration=float("inf")), "must be positive and finite"),
        (lambda p: rollout(Scenario(p, x0=np.zeros((3, 4))), SWING, KEY), "vmap over batches"),
        (
            lambda p: final_state(Scenario(p, delay=delay_steps(0.08)), SWING, KEY),
            "delay of 40 steps does not fit in a buffer of 32 states; pass delay_slots=41",
        ),
    ],
)
def test_bad_input_is_one_sentence(call, words):
    with refused(words):
        call(competition("acrobot"))


@pytest.mark.parametrize(
    ("scenario", "options", "words"),
    [
        (lambda s: s.replace(delay=np.full(4, -3)), {}, "delay is -3; it must not be negative"),
        (lambda s: s.replace(torque_noise=np.full(2, np.nan)), {}, "torque_noise holds a value"),
        (lambda s: v2("pendubot").task, {}, "is no scenario; give a Scenario or a Plant"),
        (lambda s: None, {}, "None is no scenario"),
        (lambda s: s, {"normals": np.zeros((10, 5))}, "normals have shape (10, 5); they must be"),
    ],
)
def test_what_is_no_scenario_is_refused(scenario, options, words):
    start = Scenario(competition("pendubot"))
    with refused(words):
        rollout(scenario(start), Zero(), jax.random.key(0), duration=0.02, **options)


def test_arrays_of_a_precision_that_is_off_are_refused():
    with jax.enable_x64(True):
        wide = OpenLoop(jnp.zeros(1), jnp.zeros((1, 2)))
    with refused("was made with jax_enable_x64 on, and it is off now"):
        rollout(competition("pendubot"), wide, KEY, duration=0.02)

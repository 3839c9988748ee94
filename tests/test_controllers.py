"""The classical controllers: exact where theory says what is exact, and the shipped swing-ups."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused
from scipy.linalg import schur

from jaxpend import JaxpendError, Scenario, designs, rollout
from jaxpend.controllers import (
    Ellipsoid,
    Feedback,
    Hybrid,
    OpenLoop,
    Tolerances,
    Zero,
    delay_tolerant,
    ellipsoid_of_torque,
    energy_shaping,
    free_mpc,
    load_reference,
    lqr,
    pd,
    riccati,
    save_reference,
    tracking_mpc,
    tvlqr,
)
from jaxpend.controllers.catalogue import CATALOGUE, build
from jaxpend.controllers.energy import PERIOD
from jaxpend.controllers.hybrid import with_lqr
from jaxpend.plant import dynamics, rk4_step, total_energy
from jaxpend.score import official

ROBOTS = ("acrobot", "pendubot")
UPRIGHT = np.array([np.pi, 0.0, 0.0, 0.0])
KEY = jax.random.key(0)


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def jacobians(plant, robot, step):
    """Finite-difference derivatives of ``step(x, u)`` at upright, ``u`` the driven torque."""
    joint, h = designs.active_joint(robot), 1e-6
    both = lambda u: jnp.zeros(2).at[joint].set(u)  # noqa: E731
    column = lambda d: (step(UPRIGHT + d, both(0.0)) - step(UPRIGHT - d, both(0.0))) / (2 * h)  # noqa: E731
    a = np.stack([column(h * e) for e in np.eye(4)], axis=1)
    b = (step(UPRIGHT, both(h)) - step(UPRIGHT, both(-h))) / (2 * h)
    return a, np.asarray(b)


@pytest.mark.parametrize("robot", ROBOTS)
def test_lqr_is_the_stable_subspace_of_the_hamiltonian(robot):
    """An independent solution: P from the ordered Schur form, not from scipy's Riccati solver."""
    plant, q, r = designs.competition(robot), np.array([2.0, 1.0, 0.3, 0.2]), 0.7
    found = lqr(plant, robot, q=q, r=r, dt=None)
    a, b = jacobians(plant, robot, jax.jit(lambda x, u: dynamics(plant, x, u)))
    hamiltonian = np.block([[a, -np.outer(b, b) / r], [-np.diag(q), -a.T]])
    _, vectors, _ = schur(hamiltonian, sort="lhp")
    p = vectors[4:, :4] @ np.linalg.inv(vectors[:4, :4])
    np.testing.assert_allclose(found.cost_to_go, p, rtol=1e-4)
    joint = designs.active_joint(robot)
    np.testing.assert_allclose(found.gain[joint], b @ p / r, rtol=1e-4)
    np.testing.assert_array_equal(found.gain[1 - joint], 0.0)
    assert np.linalg.eigvals(a - np.outer(b, found.gain[joint])).real.max() < 0


@pytest.mark.parametrize("robot", ROBOTS)
def test_discrete_lqr_stabilises_the_integrator_and_its_value_is_the_cost(robot):
    plant, dt = designs.competition(robot), 0.002
    found = lqr(plant, robot, q=(2.0, 1.0, 0.3, 0.2), r=0.7, dt=dt)
    joint = designs.active_joint(robot)
    a, b = jacobians(plant, robot, jax.jit(lambda x, u: rk4_step(plant, x, u, dt)))
    closed = a - np.outer(b, found.gain[joint])
    assert np.abs(np.linalg.eigvals(closed)).max() < 1
    start = 1e-3 * np.array([1.0, -1.0, 0.5, 2.0])
    cost, e = 0.0, start
    for _ in range(5000):
        u = -found.gain[joint] @ e
        cost += dt * (e @ (np.array([2.0, 1.0, 0.3, 0.2]) * e) + 0.7 * u**2)
        e = closed @ e
    np.testing.assert_allclose(found.value(UPRIGHT + start), cost, rtol=1e-3)


def test_lqr_counts_angles_modulo_a_turn_and_respects_the_limit():
    found = lqr(designs.competition("pendubot"), "pendubot")
    x = UPRIGHT + np.array([0.01, -0.02, 0.1, 0.1])
    turned = x + 2 * np.pi * np.array([1, -2, 0, 0])
    np.testing.assert_allclose(found(None, 0.0, turned)[1], found(None, 0.0, x)[1], atol=1e-9)
    assert abs(found(None, 0.0, UPRIGHT + np.array([1.0, 0, 0, 0]))[1][0]) == 6.0


@pytest.mark.parametrize("robot", ROBOTS)
def test_delay_tolerant_gain_holds_every_delay_up_to_its_own(robot):
    plant, joint = designs.competition(robot), designs.active_joint(robot)
    top = lqr(plant, robot, r=10.0)
    soft = delay_tolerant(top, plant, 0.044)
    assert not np.asarray(soft.gain[1 - joint]).any()
    a, b = jacobians(plant, robot, jax.jit(lambda x, u: rk4_step(plant, x, u, 0.002)))

    def rest(gain, delay, steps=3000):
        """How much of a deviation is left after a while."""
        past = [np.array([0.01, -0.01, 0.0, 0.0])] * (delay + 1)
        for _ in range(steps):
            past = [a @ past[0] - b * (gain[joint] @ past[delay]), *past[:delay]]
        return np.linalg.norm(past[0])

    gain = np.asarray(soft.gain, float)
    assert max(rest(gain, delay) for delay in (0, 6, 11, 17, 22)) < 1e-3
    assert rest(np.asarray(top.gain, float), 22) > 1
    with pytest.raises(JaxpendError, match=r"no gain was found that tolerates a delay of 0\.1 s"):
        delay_tolerant(top, plant, 0.1)
    with pytest.raises(JaxpendError, match=r"delay = -1 s must not be negative"):
        delay_tolerant(top, plant, -1)


def test_tvlqr_that_tolerates_delay_is_soft_once_it_has_arrived():
    plant, reference = designs.competition("pendubot"), load_reference("pendubot")
    stiff, soft = tvlqr(plant, reference, r=10.0), tvlqr(plant, reference, r=10.0, delay=0.044)
    arrived = soft.reference.steps
    off = np.abs(reference.x - reference.goal).max(axis=1)
    assert off[arrived] < 0.1 <= off[:arrived].min()
    np.testing.assert_array_equal(soft.gain, stiff.gain[:arrived])
    near = reference.goal + jnp.array([0.01, 0.02, 0.0, 0.0])
    early, late = (arrived - 1) * reference.dt, arrived * reference.dt
    np.testing.assert_array_equal(soft(None, early, near)[1], stiff(None, early, near)[1])
    torque, stiffer = soft(None, late, near)[1][0], stiff(None, late, near)[1][0]
    np.testing.assert_allclose(torque, -soft.top.gain[0] @ (near - reference.goal), rtol=1e-4)
    assert 0 < torque / stiff(None, 3.6, near)[1][0] < 0.7
    assert torque != stiffer


BAD_LQR = [
    {"q": (1, 1, 1)}, {"q": (-1, 1, 1, 1)}, {"q": (np.inf, 1, 1, 1)}, {"r": 0}, {"r": np.inf},
    {"dt": 0}, {"dt": np.inf},
]  # fmt: skip


@pytest.mark.parametrize("bad", BAD_LQR)
def test_bad_weights_of_lqr_are_one_sentence(bad):
    with pytest.raises(JaxpendError, match="LQR needs finite q of 4 values >= 0, r > 0"):
        lqr(designs.competition("acrobot"), "acrobot", **bad)


# --- the shipped swing-ups -------------------------------------------------------------------


@cache
def reference(robot):
    with jax.enable_x64(True):
        return load_reference(robot)


@pytest.mark.parametrize(("robot", "bar"), [("acrobot", 0.714), ("pendubot", 0.700)])
def test_shipped_swing_ups_reach_their_official_score(robot, bar):
    plant = designs.competition(robot)
    for make in (tvlqr, riccati):
        result = official(make(plant, reference(robot)), robot)
        assert result["success"]
        assert result["score"] >= bar
    assert result["criteria"]["max_tau"] < 3.0


def test_shipped_swing_up_obeys_the_equations_of_motion():
    found = reference("acrobot")
    plant = designs.competition("acrobot")
    step = jax.jit(jax.vmap(lambda x, u: rk4_step(plant, x, u, found.dt)))
    torques = found.both(found.u)
    np.testing.assert_allclose(step(found.x[:-1], torques), found.x[1:], atol=2e-6)
    np.testing.assert_allclose(found.x[0], 0.0)
    np.testing.assert_allclose(found.x[-1], found.goal, atol=1e-2)


def test_tvlqr_rejects_what_open_loop_does_not_and_vmap_is_a_loop():
    plant, found = designs.competition("acrobot"), reference("acrobot")
    tracking = tvlqr(plant, found)
    playing = OpenLoop(found.dt * (jnp.arange(found.steps) - 0.5), found.both(found.u))
    x0 = 0.02 * jnp.array([[1.0, 0, 0, 0], [0, -1.0, 1.0, 0], [0, 0, 0, 2.0]])

    @jax.jit
    def last(controller, x0):
        run = lambda x: rollout(Scenario(plant, x0=x), controller, KEY, duration=2.5).x[-1]  # noqa: E731
        return jax.vmap(run)(x0), run(x0[1])

    (tracked, single), (open_loop, _) = last(tracking, x0), last(playing, x0)
    np.testing.assert_allclose(tracked[1], single, atol=1e-9)
    error = lambda x: np.abs(x - found.x[1250]).max(axis=1)  # noqa: E731
    assert np.all(error(tracked) < 0.05)
    assert np.all(error(open_loop) > 1.0)


def test_tvlqr_gains_are_constant_where_the_trajectory_rests():
    """A trajectory that stays upright has the infinite-horizon gain all along."""
    rest = reference("pendubot").replace(
        x=jnp.tile(UPRIGHT, (51, 1)), u=jnp.zeros(50), gain=jnp.zeros((50, 5))
    )
    found = tvlqr(designs.competition("pendubot"), rest)
    np.testing.assert_allclose(found.gain, np.tile(found.top.gain[0], (50, 1)), rtol=1e-6)


def test_trajectory_files_round_trip_and_say_what_is_wrong(tmp_path):
    path = tmp_path / "swing.npz"
    save_reference(path, reference("acrobot"), {"score": 0.5})
    again = load_reference(path, robot="acrobot")
    np.testing.assert_array_equal(again.u, reference("acrobot").u)
    with pytest.raises(JaxpendError, match="for the acrobot, not for the pendubot"):
        load_reference(path, robot="pendubot")
    with pytest.raises(JaxpendError, match="there is no trajectory file"):
        load_reference(tmp_path / "none.npz")
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(JaxpendError, match="not a trajectory file, or it is empty or cut off"):
        load_reference(path)


# --- hybrids, PD, energy ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "region",
    [
        Tolerances(jnp.asarray(UPRIGHT), jnp.full(4, 0.1), jnp.full(4, 0.3)),
        Ellipsoid(jnp.eye(4), jnp.asarray(UPRIGHT), jnp.array(0.01), jnp.array(0.09)),
    ],
)
def test_hybrid_switches_with_hysteresis(region):
    one = Feedback(lambda t, x: jnp.array([1.0, 0.0]))
    two = Feedback(lambda t, x: jnp.array([2.0, 0.0]))
    hybrid = Hybrid(one, two, region)
    memory, torques = hybrid.reset(KEY), []
    for distance in (0.5, 0.2, 0.05, 0.2, 0.29, 0.31, 0.2, 0.09):
        memory, u = hybrid(memory, 0.0, UPRIGHT + np.array([distance, 0, 0, 0]))
        torques.append(float(u[0]))
    assert torques == [1, 1, 2, 2, 2, 1, 1, 2]


def test_ellipsoid_is_the_largest_in_which_lqr_does_not_saturate():
    top = lqr(designs.competition("acrobot"), "acrobot")
    region = ellipsoid_of_torque(top)
    direction = np.linalg.solve(top.cost_to_go, top.gain[1])
    worst = direction * np.sqrt(region.inner / (direction @ top.cost_to_go @ direction))
    np.testing.assert_allclose(top.gain[1] @ worst, 6.0, rtol=1e-9)
    others = np.random.default_rng(0).normal(size=(200, 4))
    value = np.einsum("ni,ij,nj->n", others, top.cost_to_go, others)
    others *= np.sqrt(region.inner / value)[:, None]
    assert np.abs(others @ top.gain[1]).max() <= 6.0


def test_pd_pulls_back_and_damps():
    control = pd(designs.competition("pendubot"), "pendubot", kp=3.0, kd=0.5)
    _, u = control(None, 0.0, jnp.array([np.pi + 0.2, 1.0, 0.4, 9.0]))
    np.testing.assert_allclose(u, [-3.0 * 0.2 - 0.5 * 0.4, 0.0], atol=1e-12)


@pytest.mark.parametrize("robot", ROBOTS)
def test_energy_shaping_linearises_the_driven_joint_and_pumps(robot):
    plant, a = designs.competition(robot, torque_limit=1e6), designs.active_joint(robot)
    control = energy_shaping(plant, robot, gains=(20.0, 5.0, 0.3, -0.2, 1e9, 0.1))
    x = jnp.array([0.4, -0.3, 1.2, -2.0])
    _, u = control(None, 0.0, x)
    missing = total_energy(plant, jnp.asarray(UPRIGHT)) - total_energy(plant, x)
    error = [0.4 - np.pi, -0.3][a]
    wanted = -20 * error - 5 * x[2 + a] + missing * (0.3 * 1.2 + 0.2 * 2.0 + 0.1)
    np.testing.assert_allclose(dynamics(plant, x, u)[2 + a], wanted, rtol=1e-9)
    # The surplus goes up and down: nothing at t = 0, all of it (2 J) half a period later.
    more = energy_shaping(plant, robot, gains=(20.0, 5.0, 0.3, -0.2, 1e9, 0.1), surplus=2.0)
    for t, surplus in ((0.0, 0.0), (PERIOD / 4, 1.0), (PERIOD / 2, 2.0), (PERIOD, 0.0)):
        _, u = more(None, t, x)
        pumped = wanted + surplus * (0.3 * 1.2 + 0.2 * 2.0 + 0.1)
        np.testing.assert_allclose(dynamics(plant, x, u)[2 + a], pumped, rtol=1e-9)
    result = official(build("energy_lqr", designs.competition(robot), robot), robot)
    assert result["success"]
    assert result["score"] > 0.35


# --- model predictive control ----------------------------------------------------------------


def test_mpc_with_the_tracking_cost_is_tvlqr_to_first_order():
    """Same Q, R, and the cost-to-go at the end of its horizon: the optimum is TVLQR's torque."""
    plant, found = designs.competition("pendubot"), reference("pendubot")
    weights = {"q": (1.0, 1.0, 0.1, 0.1), "r": 10.0}
    mpc = tracking_mpc(plant, found, smoothness=0.0, horizon=12, every=4, iterations=2, **weights)
    tracking = tvlqr(plant, found, **weights)
    act = jax.jit(lambda control, memory, t, x: control(memory, t, x))
    for step in (0, 400):
        x = found.x[step] + 1e-4 * jnp.array([1.0, -2.0, 3.0, 1.0])
        plan, _ = mpc.reset(KEY)
        t = jnp.array(step * found.dt)
        # A plan for another time is a bad guess only: two iterations must mend it.
        _, u = act(mpc, (plan, found.u[max(step - 1, 0)]), t, x)
        expected = tracking(None, t, x)[1]
        correction = expected[0] - found.u[step]
        np.testing.assert_allclose(u[0] - found.u[step], correction, rtol=0.02)
        assert u[1] == 0


def test_mpc_that_is_lost_finds_its_turn_and_holds_the_top():
    """Its first plan starts from hanging, and the second state is a turn away: no help there."""
    plant = designs.competition("acrobot")
    mpc = free_mpc(plant, "acrobot", horizon=20, dt=0.01, starts=1, first_iterations=1)
    x0 = 0.05 * jnp.array([[1.0, -1.0, 0, 0], [-1.0, 1.5, 0, 0]]) + UPRIGHT
    x0 = x0.at[1, 0].add(2 * np.pi)

    @jax.jit
    @jax.vmap
    def last(x0):
        return rollout(Scenario(plant, x0=x0), mpc, KEY, duration=2.0).x[-1]

    top = UPRIGHT + np.array([[0, 0, 0, 0], [2 * np.pi, 0, 0, 0]])
    np.testing.assert_allclose(last(x0), top, atol=0.05)


def test_mpc_rejects_horizons_that_do_not_fit():
    with pytest.raises(JaxpendError, match="1 <= every < horizon"):
        tracking_mpc(designs.competition("acrobot"), reference("acrobot"), horizon=5, every=5)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: free_mpc(p, "pendubot", r=-1.0), "r is -1.0; it must be positive"),
        (lambda p: free_mpc(p, "pendubot", q=(1, 1)), "q is (1, 1); it must be 4 values"),
        (lambda p: free_mpc(p, "pendubot", q=(-1, 1, 1, 1)), "q is (-1, 1, 1, 1); it must be 4"),
        (lambda p: free_mpc(p, "pendubot", smoothness=-1.0), "smoothness is -1.0; it must not be"),
        (lambda p: free_mpc(p, "pendubot", starts=0), "starts is 0; it must be positive"),
        (lambda p: free_mpc(p, "pendubot", horizon=9.5), "horizon is 9.5; it must be an integer"),
        (lambda p: free_mpc(p, "pendubot", dt=0.0), "dt is 0.0; it must be positive"),
        (lambda p: tracking_mpc(p, reference("pendubot"), every=2.5), "every is 2.5; it must be"),
        (lambda p: pd(p, "pendubot", kp=np.nan), "kp is nan; it must not be negative"),
        (lambda p: with_lqr(Zero(), p, "pendubot", fraction=-1.0), "fraction is -1.0; it must be"),
        (lambda p: with_lqr(Zero(), p, "pendubot", hysteresis=0.1), "hysteresis is 0.1; it must"),
        (lambda p: energy_shaping(p, "pendubot", (1.0,) * 5), "gains is (1.0, 1.0, 1.0, 1.0, 1.0)"),
        (lambda p: lqr(p.replace(mass=p.mass * np.nan), "pendubot"), "no LQR for this plant"),
    ],
)
def test_constants_that_make_no_sense_are_one_sentence(make, words):
    with refused(words):
        make(designs.competition("pendubot"))


# --- all of them -----------------------------------------------------------------------------


# A network has a torque limit of its own.
@pytest.mark.parametrize(
    "name", [n for n in CATALOGUE if not n.startswith("policy") and n != "mpc_free"]
)
def test_known_controllers_stay_in_their_box_and_keep_their_type(name):
    """In float32 too, with wild states, and nothing on the passive joint."""
    with jax.enable_x64(False):
        plant = designs.competition("acrobot", torque_limit=2.0)
        control = build(name, plant, "acrobot")
        states = 20 * jax.random.normal(KEY, (16, 4))

        def torque(x):
            return control(control.reset(KEY), jnp.float32(0.3), x)[1]

        u = jax.jit(jax.vmap(torque))(states)
        assert u.dtype == jnp.float32
    assert np.all(np.isfinite(u))
    assert np.abs(u).max() <= 2.0
    np.testing.assert_array_equal(u[:, 0], 0.0)


def test_unknown_controller_lists_the_known_ones():
    with pytest.raises(JaxpendError, match=r"unknown controller 'foo'; known: policy, .*tvlqr"):
        build("foo", designs.competition("acrobot"), "acrobot")

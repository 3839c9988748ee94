"""The door to Gymnasium: its checkers, and one environment and many beside the pure functions."""

import subprocess
import sys
import types

import gymnasium
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from conftest import assert_close, refused
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from matplotlib import pyplot
from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg

from jaxpend.boards import task_of, v2
from jaxpend.config import EnvConfig, Reward
from jaxpend.env import Env
from jaxpend.interop.gymnasium import DoublePendulum, VectorDoublePendulum
from jaxpend.observation import Observation

PENDUBOT, ACROBOT = "jaxpend/Pendubot-v0", "jaxpend/Acrobot-v0"
# Ends at the time limit after six steps, and sooner beyond a speed that only some reach.
SHORT = {"duration": 0.06, "upright_starts": 0.8, "upright_spread": 1.0, "max_speed": 6.0}
AGG = "module://fake_windows"


class FakeCanvas(FigureCanvasAgg):
    """A canvas that says it is of a window, where there is no display."""

    required_interactive_framework = "headless"
    drawn: list = []  # noqa: RUF012
    manager_class = FigureManagerBase

    def draw_idle(self):
        FakeCanvas.drawn.append(self.figure.axes[0].images[0].get_array())

    def start_event_loop(self, timeout=0):
        assert timeout >= 0


@pytest.fixture
def windows(monkeypatch):
    """matplotlib with a backend that has windows; the pictures that they have shown."""
    module = types.ModuleType("fake_windows")
    module.FigureCanvas, module.FigureManager = FakeCanvas, FigureManagerBase
    monkeypatch.setitem(sys.modules, "fake_windows", module)
    FakeCanvas.drawn.clear()
    before = matplotlib.get_backend()
    pyplot.switch_backend(AGG)
    yield FakeCanvas.drawn
    pyplot.close("all")
    pyplot.switch_backend(before)


@pytest.mark.parametrize("name", [PENDUBOT, ACROBOT])
def test_gymnasiums_checker_has_nothing_to_say(name, windows):
    check_env(gymnasium.make(name).unwrapped)
    assert windows


def test_what_angles_alone_show_is_within_its_bounds(windows):
    view = {"kind": "angles", "max_turn": 0.1, "history": 2}
    env = gymnasium.make(PENDUBOT, observation=view).unwrapped
    check_env(env)
    most = [1] * 4 + [10, 10, 1] * 2
    np.testing.assert_allclose(env.observation_space.high, most, rtol=1e-4)
    np.testing.assert_allclose(env.observation_space.low, -np.array(most), rtol=1e-4)


def test_stable_baselines_checker_has_nothing_to_say():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(gymnasium.make(PENDUBOT, render_mode="rgb_array").unwrapped)
    checker.check_env(gymnasium.make(ACROBOT, observation={"kind": "wrapped"}))


def test_names_are_known_with_and_without_an_import():
    code = "import gymnasium; e = gymnasium.make('jaxpend.interop.gymnasium:{0}'); "
    code += "f = gymnasium.make('{0}'); print(type(e.unwrapped) is type(f.unwrapped), "
    code += "e.unwrapped.functions.task.robot)"
    command = [sys.executable, "-W", "error", "-c", code.format(ACROBOT)]
    assert subprocess.run(command, capture_output=True, text=True).stdout == "True acrobot\n"


def test_the_default_is_the_task_of_the_paper():
    env = gymnasium.make(PENDUBOT).unwrapped
    assert env.functions == Env(EnvConfig(), v2("pendubot").task)
    assert env.functions.config.torque_limit == 3.0
    assert env.metadata["render_fps"] == 100
    # Specifications with any of the arguments survive as text.
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.functions == env.functions


def test_every_field_is_an_argument():
    env = gymnasium.make(
        ACROBOT, design="C.1/1.0", dt=0.02, torque_limit=5, max_speed="inf",
        reward={"floor": -10.0}, observation=Observation("wrapped", history=2),
    ).unwrapped  # fmt: skip
    config = EnvConfig(
        dt=0.02, torque_limit=5.0, reward=Reward(floor=-10.0),
        observation=Observation("wrapped", history=2),
    )  # fmt: skip
    assert env.functions == Env(config, task_of("acrobot", design="C.1/1.0"))
    assert env.metadata["render_fps"] == 50
    assert env.observation_space.shape == (4 * 3 + 2,)
    np.testing.assert_array_equal(env.observation_space.high, 1.0)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"torque": 3.0}, "torque is unknown; known: torque_limit, dt"),
        ({"torque_limit": -1}, "torque_limit is -1.0; it must be positive"),
        ({"reward": {"gamma": 1}}, "reward.gamma is unknown; known: line, alpha"),
        ({"reward": 3}, "reward must hold fields of Reward"),
        ({"observation": {"history": -1}}, "observation.history is -1; it must not be negative"),
        ({"observation": Reward()}, "observation.line is unknown"),
        ({"robot": "cartpole"}, "unknown robot 'cartpole'; known: acrobot, pendubot"),
        ({"design": "Z"}, "unknown design 'Z'"),
        ({"render_mode": "ansi"}, "unknown render_mode 'ansi'; known: rgb_array"),
    ],
)
@pytest.mark.parametrize("kind", [DoublePendulum, VectorDoublePendulum])
def test_bad_arguments_are_one_sentence(kind, fields, words):
    with refused(words):
        kind(**fields)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (0.5, "the action has shape (); it must have (1,)"),
        (np.zeros((1, 1)), "the action has shape (1, 1); it must have (1,)"),
        ([float("nan")], "an action is not finite"),
        ([1e300], "an action is not finite"),
        ([10**400], "; it must be numbers in [-1, 1]"),
        ([1j], "an action is [1j]; it must be numbers in [-1, 1]"),
        (["up"], "an action is ['up']; it must be numbers in [-1, 1]"),
    ],
)
def test_what_is_no_action_is_one_sentence(action, words):
    env = DoublePendulum()
    with refused("there is no episode yet; call reset first"):
        env.step(np.zeros(1))
    env.reset(seed=0)
    with refused(words):
        env.step(action)


def test_what_resets_badly_is_one_sentence():
    with refused("options of reset are state; there are none"):
        DoublePendulum().reset(options={"state": 0})
    envs = VectorDoublePendulum(num_envs=3)
    for seed in ("ab", [1, None, 2], 1.5):
        with refused(f"seed is {seed!r}; it must be integers that are not negative"):
            envs.reset(seed=seed)
    with refused("there are 2 seeds; there must be 3"):
        envs.reset(seed=[1, 2])
    with refused("there is no episode yet"):
        envs.step(np.zeros((3, 1)))
    with refused("num_envs is 0; it must be positive"):
        VectorDoublePendulum(num_envs=0)
    with refused("max_episode_steps is -1; it must be positive"):
        VectorDoublePendulum(max_episode_steps=-1)


def test_an_episode_is_that_of_the_pure_functions():
    env, rng = DoublePendulum(**SHORT), np.random.default_rng(0)
    obs, info = env.reset(seed=5)
    zero = jnp.zeros(())
    state = env.functions.observe(jnp.array(info["state"]), zero, None, None, zero)
    assert_close(obs, state.obs)
    step = jax.jit(env.functions.step)
    truncated, k = False, 0
    while not truncated:
        action, k = rng.uniform(-1.5, 1.5, 1), k + 1
        state = step(state, jnp.float32(action[0]))
        obs, reward, terminated, truncated, info = env.step(action)
        assert_close(obs, state.obs, times=5)
        assert_close(info["state"], state.x, times=5)
        assert_close(np.float32(reward), state.reward, times=50)
        assert type(reward) is float
        assert not terminated
        assert truncated == (k == 6 or np.abs(state.x[2:]).max() > 6.0)
        assert obs.flags.writeable
        assert obs.dtype == np.float32


def test_an_episode_ends_beyond_the_greatest_speed():
    env, times = DoublePendulum(**SHORT), []
    for seed in range(20):
        _, info = env.reset(seed=seed)
        truncated, k = False, 0
        while not truncated:
            assert k == 0 or np.abs(info["state"][2:]).max() <= 6.0
            _, _, _, truncated, info = env.step([0.2])
            k += 1
        assert k == 6 or np.abs(info["state"][2:]).max() > 6.0
        times.append(k)
    assert min(times) < 6 == max(times)


def test_the_same_seed_is_the_same_episodes():
    env = DoublePendulum(**SHORT)

    def starts(**seed):
        return [env.reset(**(seed if k == 0 else {}))[1]["state"] for k in range(8)]

    first, second, other = starts(seed=3), starts(seed=3), starts(seed=4)
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)
    assert len({tuple(x) for x in first}) > 2  # those that follow differ


@pytest.fixture(scope="module")
def beside():
    """Episodes of four environments in one call, and of Gymnasium's loop over four."""
    ours = gymnasium.make_vec(PENDUBOT, num_envs=4, **SHORT)
    mode = {"autoreset_mode": AutoresetMode.SAME_STEP}
    theirs = gymnasium.make_vec(PENDUBOT, 4, "sync", vector_kwargs=mode, **SHORT)
    rng, told = np.random.default_rng(0), []
    told.append([env.reset(seed=10) for env in (ours, theirs)])
    for _ in range(20):
        actions = rng.uniform(-1, 1, (4, 1)).astype(np.float32)
        told.append([env.step(actions) for env in (ours, theirs)])
    return ours, theirs, told


def same(one, other, what):
    """Nested results of the same keys and the same numbers."""
    assert type(one) is type(other), what
    if isinstance(one, dict):
        assert one.keys() == other.keys(), what
        for key in one:
            same(one[key], other[key], f"{what} {key}")
    elif one.dtype == object:
        assert [v is None for v in one] == [v is None for v in other], what
        for a, b in zip(one, other, strict=True):
            if a is not None:
                same(a, b, what)
    else:
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4, err_msg=what)


def test_many_in_one_call_are_gymnasiums_loop_over_one(beside):
    ours, theirs, told = beside
    assert isinstance(ours, VectorDoublePendulum)
    assert isinstance(theirs, SyncVectorEnv)
    assert ours.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    for space in ("observation_space", "single_observation_space", "action_space"):
        assert getattr(ours, space) == getattr(theirs, space)
    for k, pair in enumerate(told):
        for number, (one, other) in enumerate(zip(*pair, strict=True)):
            same(one, other, f"step {k}, part {number}")


def test_it_ends_and_begins_one_by_one_and_keeps_the_last(beside):
    ours, _, told = beside
    steps = [pair[0] for pair in told[1:]]
    over = np.array([step[3] for step in steps])
    assert over.any(axis=0).all()
    assert (over.any(axis=1) & ~over.all(axis=1)).any()  # some, while others go on
    for obs, reward, terminated, truncated, infos in steps:
        assert (obs.dtype, reward.dtype) == (np.float32, np.float32)
        assert not terminated.any()
        assert obs in ours.observation_space
        assert ("final_obs" in infos) == truncated.any()
        for i in np.flatnonzero(truncated):
            assert not np.allclose(infos["final_obs"][i], obs[i])
            assert_close(
                Observation()(infos["final_info"]["state"][i]), infos["final_obs"][i], times=5
            )


def test_environments_are_seeded_apart():
    envs = VectorDoublePendulum(num_envs=6, **SHORT)
    first = envs.reset(seed=7)[0]
    np.testing.assert_array_equal(envs.reset(seed=range(7, 13))[0], first)
    np.testing.assert_array_equal(envs.reset(seed=8)[0][:5], first[1:])
    assert len({tuple(x) for x in first}) > 2
    assert not np.array_equal(envs.reset()[0], envs.reset()[0])
    fresh = [VectorDoublePendulum(num_envs=6, **SHORT).reset()[0] for _ in range(2)]
    assert not np.array_equal(*fresh)


def test_one_call_steps_thousands():
    envs = gymnasium.make_vec(PENDUBOT, num_envs=2000, max_episode_steps=2, upright_starts=1.0)
    envs.reset(seed=0)
    for k in (1, 2):
        obs, reward, _, truncated, infos = envs.step(np.full((2000, 1), 0.7, np.float32))
        assert truncated.all() == truncated.any() == (k == 2)
        assert len(np.unique(reward)) > 1000
    assert len(infos["final_obs"]) == 2000
    assert obs.shape == (2000, 6)


def test_pictures_show_where_it_is():
    env = DoublePendulum(render_mode="rgb_array", upright_starts=1.0, upright_spread=1e-3)
    env.reset(seed=0)
    up = env.render()
    assert (up.shape, up.dtype) == ((320, 320, 3), np.uint8)
    envs = VectorDoublePendulum(num_envs=2, render_mode="rgb_array")
    with refused("there is no episode yet"):
        envs.render()
    envs.reset(seed=0)
    pictures = envs.render()
    assert len(pictures) == 2
    blue = [np.argwhere(np.abs(p - [0, 0x72, 0xB2]).sum(2) < 60) for p in (up, pictures[0])]
    above, below = (points[:, 0].mean() for points in blue)
    assert above < 160 < below  # link 1 is blue, rows count from the top


def test_what_has_no_mode_to_draw_in_says_so():
    for env in (DoublePendulum(), VectorDoublePendulum()):
        env.reset(seed=0)
        with pytest.warns(UserWarning, match="make it with render_mode="):
            assert env.render() is None


def test_a_window_shows_25_pictures_a_second(windows):
    env = DoublePendulum(render_mode="human")
    env.reset(seed=0)
    for _ in range(100):
        env.step([1.0])
    assert len(windows) == 1 + 25
    assert not np.array_equal(windows[0], windows[-1])
    assert env.render() is None
    assert len(windows) == 27
    env.close()
    env.close()
    env.step([1.0])
    env.render()  # the window is closed
    assert len(windows) == 27


def test_without_a_display_there_is_one_sentence():
    pyplot.switch_backend("agg")
    with refused("matplotlib's backend agg has no windows here"):
        gymnasium.make(PENDUBOT, render_mode="human")
    assert not pyplot.get_fignums()


def test_without_gymnasium_there_is_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "jaxpend.interop.gymnasium")
    with refused("pip install 'jaxpend[gymnasium]'"):
        import jaxpend.interop.gymnasium  # noqa: F401

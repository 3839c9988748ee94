"""Every value of every configuration is checked; configurations in files and as mappings."""

import dataclasses
import itertools
import json
import math
import typing

import numpy as np
import pytest
from conftest import refused

from jaxpend import config
from jaxpend.config import (
    DemonstrationConfig,
    EnvConfig,
    GradientConfig,
    GradientRun,
    Observation,
    Reward,
    Run,
    SACConfig,
    SACRun,
    Search,
    SNESConfig,
    SNESRun,
    TrainRun,
)
from jaxpend.config_files import from_mapping, load_config, recipes, to_mapping
from jaxpend.fields import Checked, Count, hints_of, split

CONFIGS = [
    kind
    for kind in (*vars(config).values(), Observation)
    if isinstance(kind, type) and issubclass(kind, Checked) and kind is not Checked
]
FIELDS = [
    (kind, field.name) for kind in dict.fromkeys(CONFIGS) for field in dataclasses.fields(kind)
]
# What may be infinite, and in which direction: there the number means "no limit".
UNLIMITED = {
    ("EnvConfig", "max_speed"): math.inf,
    ("Reward", "floor"): -math.inf,
    ("CheckpointConfig", "every"): math.inf,
    ("GradientConfig", "memory"): math.inf,
    ("GradientConfig", "tolerance"): math.inf,
}
# Text that is looked at where it is used: names of files and of parts of a network.
FREE_TEXT = {"coordinator", "run", "runs", "plant", "design", "policy", "controller", "searched"}


def wrong_values(kind: type, name: str) -> list:
    """Values that no field of this type takes, whatever it means."""
    hint, _, optional = split(hints_of(kind)[name])
    wrong = [[], {}, object(), b"x", *([] if optional else [None])]
    if typing.get_origin(hint) is tuple:
        inner = split(typing.get_args(hint)[0])[0]
        bad = (0, -5, True, math.nan, math.inf, "text", None, *([1.5, 3.0] if inner is int else []))
        return [*wrong, (), 64, "64", *((64, value) for value in bad)]
    if hint is int:
        return [*wrong, True, 3.0, 1.5, math.nan, math.inf, -1, 2**31, 10**400, "3", np.float32(3)]
    if hint is float:
        allowed = UNLIMITED.get((kind.__name__, name))
        infinite = [value for value in (math.inf, -math.inf) if value != allowed]
        return [*wrong, True, math.nan, *infinite, "3", np.float64("nan"), 10**400]
    if hint is bool:
        return [*wrong, 0, 1, "yes", 1.0]
    if hint is str:
        return [*wrong, 3, True, "a\0b"]
    if typing.get_origin(hint) is typing.Literal:
        return [*wrong, 3, "", "cartpole"]
    return [*wrong, 3, "text"]


@pytest.mark.parametrize(("kind", "name"), FIELDS)
def test_no_field_takes_what_makes_no_sense(kind, name):
    for value in wrong_values(kind, name):
        with refused(f"{name} is ", start=f"{name} is "):
            kind(**{name: value})


def test_every_text_is_free_or_one_of_a_few():
    texts = {name for kind, name in FIELDS if split(hints_of(kind)[name])[0] is str}
    assert texts == FREE_TEXT


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SACConfig(discount=1.0), "discount is 1.0; it must be below 1"),
        (lambda: SACConfig(discount=0.0), "discount is 0.0; it must be positive"),
        (lambda: SACConfig(target_rate=1.5), "target_rate is 1.5; it must be at most 1"),
        (lambda: SACConfig(steps=0), "steps is 0; it must be positive"),
        (lambda: SACConfig(actor_hidden=()), "actor_hidden is (); it must be one or more values"),
        (lambda: SACConfig(critic_hidden=(64, -5)), "each of which must be positive"),
        (
            lambda: SACConfig(replay_capacity=31),
            "it must hold n_step = 1 steps of all 32 environments",
        ),
        (
            lambda: SACConfig(batch_size=1, demonstrations=DemonstrationConfig(episodes=1)),
            "batch_size is 1; it must be at least 2, half are demonstrations",
        ),
        (
            lambda: SACConfig(demonstrations=DemonstrationConfig(1, 0.01), env=EnvConfig(dt=0.02)),
            "demonstrations.duration is 0.01; it must not be shorter than env.dt",
        ),
        (lambda: EnvConfig(dt=0.5, duration=0.4), "dt is 0.5; it must not be longer than an e"),
        # No policy file says so long a period.
        (lambda: EnvConfig(dt=1.5), "dt is 1.5; it must be at most 1"),
        (lambda: EnvConfig(randomised=1.5), "randomised is 1.5; it must be at most 1"),
        (lambda: EnvConfig(upright_starts=-0.1), "it must not be negative"),
        (lambda: Reward(floor=math.inf), "floor is inf; it must be at most 0"),
        (
            lambda: SACConfig(mirror=True, env=EnvConfig(observation=Observation(mean=(0.1,) * 6))),
            "mirror is on, but the mean of the observation is not the same left and right; turn",
        ),
        (lambda: Observation(mean=(0.0,) * 4), "it must be 6 values, as many as 'sincos' sees of"),
        (lambda: Observation("state", std=(1.0,) * 6), "it must be 4 values, as many as 'state'"),
        (lambda: Observation(std=(0.0,) * 6), "one or more values, each of which must be positive"),
        (lambda: Observation(mean=(math.nan,) * 6), "values, each of which must be a number"),
        (lambda: Observation(clip=0.0), "clip is 0.0; it must be positive"),
        (lambda: Observation(history=-1), "history is -1; it must not be negative"),
        (
            lambda: Observation("angles"),
            "history is 0; angles are seen without velocities, but for",
        ),
        (lambda: Observation("angles", history=1, clip=0.5), "clip is 0.5; angles are not normali"),
        (lambda: Observation(history=10**9), "history is 1000000000; it must be at most 1,000"),
        (lambda: Observation(std=(1e-300,) * 6), "each of which must be at least 1e-09"),
        (lambda: SNESConfig(population=1), "population is 1; it must be at least 2"),
        (lambda: SNESConfig(strategy="open_es", population=5), "open_es needs pairs"),
        (lambda: Search(horizons=(1.2, 3.0)), "not be shorter than the longest of horizons"),
        (lambda: Search(horizons=()), "horizons is (); it must be one or more values"),
        (lambda: Search(starts=-1), "starts is -1; it must be positive"),
        (lambda: Run(seed=-1), "seed is -1; it must not be negative"),
        (lambda: Run(seed=2**31 - 1), "seed is 2147483647; it must be below 2,147,483,647"),
        (lambda: Run(seed=2**31 - 2, seeds=2), "from seed 2147483646 on there are not so many"),
        (lambda: Run(plant="a", design="b"), "plant and design are both given"),
        (lambda: GradientRun(gradient=GradientConfig(steps=0)), "gradient.steps is 0"),
        (lambda: Run(robot="cartpole"), "robot is 'cartpole'; it must be acrobot or pendubot"),
        (lambda: SACConfig(activation="gelu"), "activation is 'gelu'; it must be relu, tanh or"),
    ],
)
def test_what_must_fit_together_and_how_it_is_said(make, words):
    with refused(words):
        make()


def test_what_is_meant_is_taken():
    assert SACConfig(batch_size=1).batch_size == 1  # without demonstrations
    mean = (0.1, 0.2, 0.0, 0.0, 0.0, 0.0)  # of cosines, which are the same in a mirror
    SACConfig(mirror=True, env=EnvConfig(observation=Observation(mean=mean)))
    assert Reward(floor=-math.inf, line=None).floor == -math.inf
    assert GradientConfig(memory=math.inf).memory == math.inf
    assert Run(seed=2**31 - 2).seed == 2**31 - 2
    assert Search(horizons=(2.6,)).horizons == (2.6,)


def test_values_become_pythons_own_and_hashable():
    found = SACConfig(
        actor_hidden=[np.int64(4), 5], learning_rate=np.float32(0.5), steps=np.int32(9)
    )
    assert found == SACConfig(actor_hidden=(4, 5), learning_rate=0.5, steps=9)
    assert [type(v) for v in (*found.actor_hidden, found.learning_rate)] == [int, int, float]
    assert hash(found) == hash(dataclasses.replace(found))
    assert isinstance(EnvConfig(duration=10).duration, float)
    json.dumps(to_mapping(found))


# --- as mappings and in files --------------------------------------------------------------

SECTIONS = (
    "policy",
    "guard",
    "sac",
    "shac",
    "openings",
    "gradient",
    "snes",
)  # that a command may have no field for


@dataclasses.dataclass(frozen=True)
class Inner(Checked):
    """A section."""

    speed: float = 2.0
    sizes: tuple[Count, ...] = (1, 2)


@dataclasses.dataclass(frozen=True)
class Outer(Checked):
    """A configuration."""

    count: int = 3
    name: str = "a"
    fast: bool = False
    inner: Inner = dataclasses.field(default_factory=Inner)


def test_named_fields_are_replaced_and_the_others_kept():
    changed = from_mapping(Outer(), {"count": 4, "inner": {"sizes": [5], "speed": 3}}, "x")
    assert changed == Outer(count=4, inner=Inner(3.0, (5,)))
    assert isinstance(changed.inner.speed, float)
    assert from_mapping(Outer(), {}, "x") == Outer()


def test_numbers_that_yaml_takes_for_text(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("inner: {speed: 1e-3}")
    assert load_config(Outer(), path).inner.speed == 1e-3


@pytest.mark.parametrize("given", [Outer(name="b"), TrainRun("acrobot"), SNESRun(seed=4)])
def test_a_stored_configuration_is_strict_json_and_reads_back(given, tmp_path):
    text = json.dumps(to_mapping(given), allow_nan=False)
    (tmp_path / "config.json").write_text(text)
    assert load_config(type(given)(), tmp_path / "config.json") == given
    assert from_mapping(type(given)(), json.loads(text), "x") == given


DEEP = "[" * 5000 + "]" * 5000
BAD = [
    ("cout: 4", "cout is unknown; known: count, name, fast, inner"),
    ("3: 4", "3 is unknown; known: count"),
    ("? null\n: 4", "None is unknown; known: count"),
    ("inner: {sped: 4}", "inner.sped is unknown; known: speed, sizes"),
    ("count: many", "count is 'many'; it must be an integer"),
    ("count: 1.5", "count is 1.5; it must be an integer"),
    ("count: 3.0", "count is 3.0; it must be an integer"),
    ("count: true", "count is True; it must be an integer"),
    ("count: .nan", "count is nan; it must be an integer"),
    ("count: null", "count is None; it must be an integer"),
    ("count: 2020-01-01", "count is datetime.date(2020, 1, 1); it must be an integer"),
    ("name: 3", "name is 3; it must be a text"),
    ("name: [a]", "name is 'a'; it must be a text"),
    ("fast: 1", "fast is 1; it must be yes or no"),
    ("inner: {speed: fast}", "inner.speed is 'fast'; it must be a number"),
    ("inner: {speed: true}", "inner.speed is True; it must be a number"),
    ("inner: {speed: .inf}", "inner.speed is inf; it must be finite"),
    ("inner: {speed: .nan}", "inner.speed is nan; it must be a number"),
    ("inner: {sizes: 4}", "inner.sizes is 4; it must be one or more values, each an integer"),
    ("inner: {sizes: []}", "inner.sizes is []; it must be one or more values, each an integer"),
    ("inner: {sizes: [[1]]}", "inner.sizes is [[1]]; it must be one or more values, each of"),
    ("inner: {sizes: {a: 1}}", "inner.sizes is {'a': 1}; it must be one or more values"),
    ("inner: 4", "inner must hold fields of Inner: speed, sizes"),
    ("- count", "must hold fields of Outer: count, name, fast, inner"),
    ("text", "must hold fields of Outer"),
    ("count: [", "is not valid YAML, line 1"),
    ("count: 3\n\tname: a", "is not valid YAML, line 2"),
    ("a: 1\n- b", "is not valid YAML, line 2"),
    ("count: !!python/object:os.system x", "is not valid YAML, line 1"),
    ("count: !!timestamp x", "is not valid YAML"),
    ("count: !!int ''", "is not valid YAML"),
    ("count: 2020-13-45", "is not valid YAML"),
    ("{[1, 2]: 3}", "is not valid YAML"),
    ("count: \x07", "is not valid YAML"),
    ("count: " + "9" * 5000, "is not valid YAML"),
    (f"count: {DEEP}", "is nested too deeply, or holds itself"),
    ("&a [*a]", "must hold fields of Outer"),
    ("inner: &a {sizes: *a}", "; it must be one or more values"),
    ("inner: {sizes: &a [*a]}", "; it must be one or more values"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "words"), BAD, ids=[text[:30] for text, _ in BAD])
def test_bad_files_are_one_sentence(tmp_path, text, words):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with refused(words, start=str(path)):
        load_config(Outer(), path)


def test_files_that_cannot_be_read_are_one_sentence(tmp_path):
    with refused("nothing.yaml", start="there is no configuration file "):
        load_config(Outer(), tmp_path / "nothing.yaml")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x9f")
    with refused("is not valid YAML"):
        load_config(Outer(), tmp_path / "binary")
    with refused("Is a directory", start=f"cannot read {tmp_path}"):
        load_config(Outer(), tmp_path)
    for name in ("a" * 300, ""):
        with refused(""):
            load_config(Outer(), name)


def test_the_source_of_fields_that_do_not_fit_together_is_named(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("sac: {replay_capacity: 3}")
    with refused("replay_capacity is 3", start=f"{path}: sac.replay_capacity is 3; it must hold"):
        load_config(TrainRun(), path)


def test_sections_of_other_commands_are_passed_over_only_where_said(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("count: 5\nsac: {steps: 1}")
    assert load_config(Outer(), path, also=("sac",)) == Outer(count=5)
    with refused("sac is unknown"):
        load_config(Outer(), path, also=("snes",))
    path.write_text("inner: {speed: 3}")  # a section that there is a field for is read
    assert load_config(Outer(), path, also=("inner",)).inner.speed == 3
    path.write_text("")
    assert load_config(Outer(), path) == Outer()


def test_the_recipes_are_valid_for_every_training_command():
    robots = ("acrobot", "pendubot")
    kinds = ("demonstrated_", "global_", "hardware_")
    of_either = ["low_torque", "plain"]
    assert recipes() == sorted([*robots, *of_either, *(k + r for k in kinds for r in robots)])
    for name, kind in itertools.product(recipes(), (SACRun, SNESRun, TrainRun)):
        run = load_config(kind(), name, SECTIONS)
        named = name.rpartition("_")[2]
        assert run.robot == (named if named in robots else "pendubot")
        board = {"global": "v3", "hardware": "hardware"}.get(name.partition("_")[0], "v2")
        assert run.board == board
        if kind is not SACRun:
            assert run.snes == load_config(TrainRun(), name, SECTIONS).snes

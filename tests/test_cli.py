"""What every command shares: exit codes, one-sentence errors, strict JSON, configuration."""

import importlib
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Literal

import jax
import jaxlib
import numpy as np
import pytest

import jaxpend
from jaxpend import JaxpendError, __version__, cli
from jaxpend.cli import app, commands
from jaxpend.config import TrainRun
from jaxpend.train.interrupt import Stopped

RECIPE = "pendubot"


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (JaxpendError("no such thing"), 2, "prog: no such thing\n"),
        (FileNotFoundError(2, "No such file", "a/b"), 2, "prog: cannot use a/b: No such file\n"),
        (OSError("odd"), 2, "prog: cannot use: odd\n"),
        (KeyboardInterrupt(), 130, "prog: interrupted\n"),
        (Stopped(signal.SIGTERM, "stopped"), 143, "prog: stopped\n"),
    ],
)
def test_what_goes_wrong_is_one_sentence_and_an_exit_code(capsys, error, code, words):
    with pytest.raises(SystemExit) as exit_, cli.guard("prog"):
        raise error
    assert exit_.value.code == code
    assert capsys.readouterr() == ("", words)


def test_other_errors_are_bugs_and_keep_their_traceback():
    with pytest.raises(ZeroDivisionError), cli.guard("prog"):
        1 / 0  # noqa: B018


def main(
    where: Path = Path("here"),
    /,
    robot: str = "pendubot",
    keys: int = 3,
    plot: bool = True,
    kind: Literal["fast", "slow"] = "fast",
    pair: tuple[str, str] | None = None,
) -> None:
    """A command."""
    if robot not in ("acrobot", "pendubot"):
        raise JaxpendError(f"unknown robot {robot!r}")
    print(where, robot, keys, plot, kind, pair)


def run(monkeypatch, capsys, arguments, function=main):
    """Exit code, standard output and standard error of a command in this process."""
    monkeypatch.setattr("sys.argv", ["prog", *arguments.split()])
    with pytest.raises(SystemExit) as exit_:
        cli.run(function, "prog") if function is main else function()
    return exit_.value.code, *capsys.readouterr()


@pytest.mark.parametrize(
    ("arguments", "out"),
    [
        ("", "here pendubot 3 True fast None\n"),
        ("there --robot acrobot --keys 5", "there acrobot 5 True fast None\n"),
        ("--keys=1_000 --kind slow", "here pendubot 1000 True slow None\n"),
        ("--no-plot", "here pendubot 3 False fast None\n"),
        ("--plot", "here pendubot 3 True fast None\n"),
        ("--plot False", "here pendubot 3 False fast None\n"),
        ("--plot=no", "here pendubot 3 False fast None\n"),
        ("--plot off --keys 1", "here pendubot 1 False fast None\n"),
        ("--plot YES --pair a b", "here pendubot 3 True fast ('a', 'b')\n"),
    ],
)
def test_run_parses_calls_and_exits(monkeypatch, capsys, arguments, out):
    assert run(monkeypatch, capsys, arguments) == (0, out, "")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--robot cartpole", "unknown robot 'cartpole'"),
        ("--keis 5", "unknown option --keis; did you mean --keys?"),
        ("--keis=5", "unknown option --keis; did you mean --keys?"),
        ("--nothing-like-it", "unknown option --nothing-like-it; see prog --help"),
        ("-k 5", "unknown option -k; see prog --help"),
        ("here there", "unexpected argument 'there'; see prog --help"),
        ("--keys many", "--keys is 'many'; it must be an integer"),
        ("--keys=1.5", "--keys is '1.5'; it must be an integer"),
        ("--keys", "--keys needs a value: an integer"),
        ("--plot perhaps --keys x", "--keys is 'x'; it must be an integer"),
        ("here --plot perhaps", "--plot is 'perhaps'; it must be yes or no"),
        ("here --plot= --keys 1", "unexpected argument ''; see prog --help"),
        ("--kind quick", "--kind is 'quick'; it must be fast or slow"),
        ("--pair a", "--pair is 'a'; it must be 2 values, each a text"),
    ],
)
def test_what_is_wrong_on_the_command_line_is_one_sentence(monkeypatch, capsys, arguments, words):
    assert run(monkeypatch, capsys, arguments) == (2, "", f"prog: {words}\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--sac.stepz 4", "unknown option --sac.stepz; did you mean --sac.steps?"),
        ("--steps 4", "unknown option --steps; did you mean --sac.steps?"),
        ("--sac.steps x", "--sac.steps is 'x'; it must be an integer"),
        ("--sac.actor_hidden 8 a", "--sac.actor-hidden is '8 a'; it must be any number of values, "
         "each an integer"),
        ("--sac.env.reward.line up", "--sac.env.reward.line is 'up'; it must be a number"),
        ("--conf x", "unknown option --conf; did you mean --config?"),
        ("--config", "--config needs a YAML file"),
        ("--config --seed 3", "--config needs a YAML file"),
        ("--sac.steps 0", "steps is 0; it must be positive"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_configuration_is_one_sentence(monkeypatch, capsys, arguments, words):
    arguments = f"train {arguments}"
    done = run(monkeypatch, capsys, arguments, cli.main)
    assert done == (2, "", f"jaxpend train: {words}\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("scor", "unknown command 'scor'; did you mean score?"),
        ("frobnicate", "unknown command 'frobnicate'; see jaxpend --help"),
        ("--hlep", "unknown option '--hlep'; did you mean --help?"),
    ],
)
def test_unknown_commands_are_one_sentence(monkeypatch, capsys, arguments, words):
    done = run(monkeypatch, capsys, arguments, cli.main)
    assert done == (2, "", f"jaxpend: {words}\n")


def test_without_the_hook_tyro_says_what_is_wrong(monkeypatch, capsys):
    monkeypatch.delattr("tyro._errors.on_parse_error")
    code, out, err = run(monkeypatch, capsys, "--keis 5")
    assert (code, out) == (2, "")
    assert "--keis" in err
    assert "Traceback" not in err


def test_version_names_what_results_depend_on(monkeypatch, capsys):
    code, out, err = run(monkeypatch, capsys, "--version", cli.main)
    python = ".".join(map(str, sys.version_info[:3]))
    expected = f"jaxpend {__version__}\njax {jax.__version__}\njaxlib {jaxlib.__version__}\n"
    assert (code, out, err) == (0, f"{expected}python {python}\n", "")


def test_the_overview_lists_every_command_once_under_its_group(monkeypatch, capsys):
    for arguments in ("", "--help", "-h"):
        code, out, err = run(monkeypatch, capsys, arguments, cli.main)
        assert (code, err) == (0, "")
        lines = out.splitlines()
        assert len(lines) < 35
        for name, command in cli.COMMANDS.items():
            (line,) = [i for i, text in enumerate(lines) if text.startswith(f"  {name} ")]
            assert command.summary in lines[line]
            heading = next(text for text in reversed(lines[:line]) if text[:1].strip())
            assert heading == f"{command.group}:"


# Runs the command line with each of several arguments in turn, and says which of the slow
# packages have been loaded in the end.
HELP = """
import contextlib, io, sys
from jaxpend import cli
for arguments in sys.stdin.read().splitlines():
    sys.argv, out, err = ["jaxpend", *arguments.split()], io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            cli.main()
    except SystemExit as end:
        print(arguments, end.code, len(out.getvalue()), len(err.getvalue()), sep=";")
slow = {"jax", "jaxlib", "numpy", "scipy", "flax", "optax", "brax", "mujoco", "evosax", "orbax"}
print(sorted(slow & set(sys.modules)))
"""


def test_help_and_refusals_do_not_wait_for_jax(tmp_path):
    ends = ["--help", "--no-such-option"]
    lines = [f"{name} {end}" for name in cli.COMMANDS for end in ends]
    lines += ["--help", "--version", f"runs {tmp_path}", "train --sac.steps x"]
    lines += ["score --robot cartpole", f"snes --config {RECIPE} --snes.population 1"]
    done = subprocess.run(
        [sys.executable, "-c", HELP], input="\n".join(lines), capture_output=True, text=True
    )
    assert done.stderr == ""
    *each, slow = done.stdout.splitlines()
    assert slow == "[]"
    assert len(each) == len(lines)
    for line in each:
        arguments, code, out, err = line.split(";")
        fine = arguments.endswith(("--help", "--version"))
        assert (int(code), int(out) > 0, int(err) > 0) == (
            (0, True, False) if fine else (2, False, True)
        )


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_has_an_example_that_parses(monkeypatch, capsys, name):
    code, out, err = run(monkeypatch, capsys, f"{name} --help", cli.main)
    example = cli.COMMANDS[name].example
    assert (code, err) == (0, "")
    assert f"example: jaxpend {name} {example}" in " ".join(out.split())
    module, _, function = (cli.COMMANDS[name].function or f"commands:{name}").partition(":")
    function = getattr(importlib.import_module(f"jaxpend.cli.{module}"), function)
    call = cli.parse(function, "prog", example.split())
    assert call.func is function
    assert call.args or call.keywords


def test_a_training_command_knows_its_command_line():
    call = cli.parse(commands.sac, "jaxpend sac", ["--seed", "4", "--run", "a b"])
    assert call.keywords == {"command": "jaxpend sac --seed 4 --run 'a b'"}
    assert (call.args[0].seed, call.args[0].run) == (4, "a b")


def test_the_package_has_its_names_whatever_was_imported_first():
    code = "import jaxpend.rollout, jaxpend; from jaxpend import *; from jaxpend import rollout; "
    code += "assert rollout is jaxpend.rollout and callable(rollout); "
    code += "print(*sorted(n for n in jaxpend.__all__ if n in dir(jaxpend) and eval(n)))"
    code = "import jaxpend.score; " + code
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == sorted(jaxpend.__all__), done.stderr
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        jaxpend.no_such_name  # noqa: B018


def test_where_compiled_programs_are_kept(monkeypatch, tmp_path):
    for name in ("JAXPEND_CACHE", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert app._cache_folder() == tmp_path / ".cache" / "jaxpend" / "xla"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert app._cache_folder() == tmp_path / ".cache" / "jaxpend" / "xla"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert app._cache_folder() == tmp_path / "xdg" / "jaxpend" / "xla"
    for off in ("off", "0", "No", "FALSE"):
        monkeypatch.setenv("JAXPEND_CACHE", off)
        assert app._cache_folder() is None
    monkeypatch.setenv("JAXPEND_CACHE", "~/mine")
    assert app._cache_folder() == tmp_path / "mine"
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "jax")
    assert app._cache_folder() is None


def score(**environment):
    """Standard output of ``jaxpend score`` for the shipped policy."""
    line = [sys.executable, "-m", "jaxpend", "score", "--json", "-"]
    environment = os.environ | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"} | environment
    done = subprocess.run(line, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_compiled_programs_are_kept_and_change_nothing(tmp_path):
    cache = tmp_path / "cache"
    expected = score(JAXPEND_CACHE="off", XDG_CACHE_HOME=str(tmp_path))
    assert not list(tmp_path.iterdir())
    assert score(JAXPEND_CACHE=str(cache)) == expected
    kept = {path.name: path.read_bytes() for path in cache.iterdir()}
    assert any("nominal" in name for name in kept)
    # Cut off by a crash: compiled again, without a word. The others are used, not written again.
    for path in cache.glob("*nominal*"):
        path.write_bytes(path.read_bytes()[:100])
    before = {path: path.stat().st_mtime_ns for path in cache.iterdir()}
    assert score(JAXPEND_CACHE=str(cache)) == expected
    assert {path: path.stat().st_mtime_ns for path in cache.iterdir()} == before


def test_a_cache_folder_that_cannot_be_used_is_passed_over(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    result = json.loads(score(JAXPEND_CACHE=str(tmp_path / "file" / "deep")))
    assert result["success"]


NUMBERS = {
    "score": np.float32(0.5),
    "worst": math.nan,
    "rows": [np.array([1.0, math.inf]), (-math.inf, 2)],
    "success": np.bool_(True),
    "name": "x",
}
PLAIN = {
    "score": 0.5, "worst": None, "rows": [[1.0, None], [None, 2]], "success": True, "name": "x",
}  # fmt: skip


def test_json_has_numbers_or_null(tmp_path, capsys):
    cli.emit_json(NUMBERS, "-")
    out, err = capsys.readouterr()
    assert json.loads(out, parse_constant=pytest.fail) == PLAIN
    assert err == ""
    path = tmp_path / "new" / "result.json"
    cli.emit_json(NUMBERS, path)
    assert path.read_text() == out
    cli.emit_json(NUMBERS, None)
    assert capsys.readouterr() == ("", "")


def configured(*arguments):
    """The configuration that a training command makes of its arguments."""
    return cli.parse(commands.train, "prog", list(map(str, arguments))).args[0]


def test_options_override_the_file_which_overrides_the_defaults(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("robot: acrobot\nseed: 3\nsac: {discount: 0.9, actor_hidden: [4, 5]}")
    for named in (["--config", path], [f"--config={path}"]):
        config = configured(*named, "--seed", 5, "--sac.env.reward.line", 0.4)
        assert (config.robot, config.seed, config.sac.discount) == ("acrobot", 5, 0.9)
        assert config.sac.actor_hidden == (4, 5)
        assert (config.sac.env.robot, config.sac.env.reward.line) == ("acrobot", 0.4)
        assert config.snes == TrainRun().snes


def test_flags_of_a_section_are_yes_or_no():
    for arguments in (["--sac.critic-layer-norm"], ["--sac.critic_layer_norm", "yes"]):
        assert configured(*arguments).sac.critic_layer_norm
    for arguments in ([], ["--sac.no-critic-layer-norm"], ["--sac.critic-layer-norm=off"]):
        assert not configured(*arguments).sac.critic_layer_norm


def test_the_robot_option_reaches_the_environment():
    config = configured("--robot", "acrobot")
    assert (config.sac.env.robot, config.sac.env.reward.line) == ("acrobot", 0.375)
    config = configured("--robot", "acrobot", "--sac.env.reward.line", 0.4)
    assert config.sac.env.reward.line == 0.4

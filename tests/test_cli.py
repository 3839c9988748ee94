"""What every command shares: exit codes, one-sentence errors, strict JSON, configuration."""

import io
import json
import math
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Literal

import jax
import jaxlib
import numpy as np
import pytest

import jaxpend
from jaxpend import JaxpendError, __version__, cli, designs
from jaxpend.cli import cache, commands, output
from jaxpend.config import TrainRun
from jaxpend.config_files import recipes
from jaxpend.fields import Count
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
    with pytest.raises(SystemExit) as exit_, cli.one_sentence("prog"):
        raise error
    assert exit_.value.code == code
    assert capsys.readouterr() == ("", words)


def test_other_errors_are_bugs_and_keep_their_traceback():
    with pytest.raises(ZeroDivisionError), cli.one_sentence("prog"):
        1 / 0  # noqa: B018


def main(
    where: Path = Path("here"),
    /,
    robot: str = "pendubot",
    keys: Count = 3,
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
        ("--plot --pair a b", "here pendubot 3 True fast ('a', 'b')\n"),
        ("--plot there", "there pendubot 3 True fast None\n"),
        ("--pair None --keys 1 --keys 2", "here pendubot 2 True fast None\n"),
        ("-", "- pendubot 3 True fast None\n"),
        ("--no-plot there", "there pendubot 3 False fast None\n"),
        ("--keys 1 -- --with_this", "--with_this pendubot 1 True fast None\n"),
        ("--robot=pendubot --pair -1e3 -inf", "here pendubot 3 True fast ('-1e3', '-inf')\n"),
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
        ("--keys --plot", "--keys needs a value: an integer"),
        ("--keys=", "--keys is ''; it must be an integer"),
        ("--keys 0", "--keys is 0; it must be positive"),
        ("--keys -3", "--keys is -3; it must be positive"),
        ("--keys 1e3", "--keys is '1e3'; it must be an integer"),
        (
            "--keys 99999999999",
            "--keys is 99999999999; it must be from -2,147,483,647 to 2,147,483,647",
        ),
        ("here --plot perhaps --keys x", "--plot is 'perhaps'; it must be yes or no"),
        ("here --plot perhaps", "--plot is 'perhaps'; it must be yes or no"),
        ("here --plot= --keys 1", "--plot is ''; it must be yes or no"),
        ("--kind quick", "--kind is 'quick'; it must be fast or slow"),
        ("--pair a", "--pair is 'a'; it must be 2 values, each a text"),
        ("--no-plot=yes", "--no-plot takes no value; --plot does"),
        ("--plot=there", "--plot is 'there'; it must be yes or no"),
        ("--plot there here", "unexpected argument 'here'; see prog --help"),
        ("--no-plat", "unknown option --no-plat; did you mean --no-plot?"),
        ("--robo acrobot", "unknown option --robo; did you mean --robot?"),
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
        ("--sac.actor-hidden 8 a", "--sac.actor_hidden is '8 a'; it must be one or more values, "
         "each of which must be an integer"),
        ("--sac.actor-hidden 8 0", "--sac.actor_hidden is '8 0'; it must be one or more values, "
         "each of which must be positive"),
        ("--sac.env.reward.line up", "--sac.env.reward.line is 'up'; it must be a number"),
        ("--sac.env.dt nan", "--sac.env.dt is nan; it must be positive"),
        ("--sac.env.dt -inf", "--sac.env.dt is -inf; it must be positive"),
        ("--sac.env.dt inf", "--sac.env.dt is inf; it must be at most 1"),
        ("--sac.env.torque-limit inf", "--sac.env.torque_limit is inf; it must be finite"),
        ("--sac.target-entropy nan", "--sac.target_entropy is nan; it must be a number"),
        ("--sac.env.robot acrobot", "unknown option --sac.env.robot; did you mean --sac.env.dt?"),
        ("--sac.replay-capacity 8", "--sac.replay_capacity is 8; it must hold n_step = 1 steps of "
         "all 32 environments"),
        ("--seed -1", "--seed is -1; it must not be negative"),
        ("--seed 2147483647", "--seed is 2147483647; it must be below 2,147,483,647"),
        ("--seed 2147483640 --seeds 8", "--seeds is 8; from seed 2147483640 on there are not so "
         "many"),
        ("--plant a.yaml --design C.1/1.0", "--plant and design are both given; a run has one of "
         "them"),
        ("--conf x", "unknown option --conf; did you mean --config?"),
        ("--config", f"--config needs a YAML file, or a recipe: {', '.join(recipes())}"),
        ("--config --seed 3", f"--config needs a YAML file, or a recipe: {', '.join(recipes())}"),
        ("--config nothing", "there is no configuration file nothing, and no such recipe: "
         f"{', '.join(recipes())}"),
        ("--sac.steps 0", "--sac.steps is 0; it must be positive"),
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
    function = cli.function_of(name)
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
    assert cache.cache_folder() == tmp_path / ".cache" / "jaxpend" / "xla"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache.cache_folder() == tmp_path / ".cache" / "jaxpend" / "xla"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_folder() == tmp_path / "xdg" / "jaxpend" / "xla"
    for off in ("off", "0", "No", "FALSE"):
        monkeypatch.setenv("JAXPEND_CACHE", off)
        assert cache.cache_folder() is None
    monkeypatch.setenv("JAXPEND_CACHE", "~/mine")
    assert cache.cache_folder() == tmp_path / "mine"
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "jax")
    assert cache.cache_folder() is None


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
    assert any("trial_run" in name for name in kept)
    # Cut off by a crash: compiled again, without a word. The others are used, not written again.
    cut = list(cache.glob("*trial_run*"))
    assert cut
    for path in cut:
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
        assert config.sac.env.reward.line == 0.4
        assert config.snes == TrainRun().snes


def test_flags_of_a_section_are_yes_or_no():
    for arguments in (["--sac.critic-layer-norm"], ["--sac.critic_layer_norm", "yes"]):
        assert configured(*arguments).sac.critic_layer_norm
    for arguments in ([], ["--sac.no-critic-layer-norm"], ["--sac.critic-layer-norm=off"]):
        assert not configured(*arguments).sac.critic_layer_norm


# --- the process around a command ----------------------------------------------------------


def command(line, stdout=subprocess.PIPE, **environment):
    """A command in a shell, as a process of its own; ``jaxpend`` is this package's."""
    line = line.replace("jaxpend", f"{sys.executable} -m jaxpend", 1)
    return subprocess.run(
        ["bash", "-c", line], stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=120,
        env=os.environ | environment, pass_fds=[stdout] if stdout > 2 else (),
    )  # fmt: skip


@pytest.fixture
def runs(tmp_path):
    """A folder with a run in it."""
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    (tmp_path / "runs" / "mine" / "config.json").write_text('{"robot": "acrobot", "seed": 1}')
    return tmp_path / "runs"


@pytest.mark.parametrize(
    ("line", "code"),
    [("--help", 141), ("train -H", 141), ("runs {} --json -", 141), ("runs {} 2>&1", 141),
     ("runs {}/none 2>&1", 2)],
)  # fmt: skip
def test_nobody_reads_the_output_any_more(runs, line, code):
    reader, writer = os.pipe()
    os.close(reader)
    done = command(f"jaxpend {line.format(runs)}".replace("2>&1", f"2>&{writer}"), stdout=writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (code, "")


def test_output_that_is_closed_or_full(runs):
    done = command(f"jaxpend runs {runs} --json - >&-")
    words = "jaxpend runs: standard output is closed; name a file instead of -\n"
    assert (done.returncode, done.stderr) == (2, words)
    assert command(f"jaxpend runs {runs} >&- 2>&-").returncode == 0
    assert command(f"jaxpend runs {runs}/none >&- 2>&-").returncode == 2
    done = command("jaxpend score --robot pendubot --json /dev/full")
    words = "jaxpend score: cannot use /dev/full: No space left on device"
    assert (done.returncode, done.stderr.splitlines()[-1]) == (2, words)
    done = command(f"jaxpend runs {runs} --json - >/dev/full")
    words = "jaxpend runs: cannot use: No space left on device\n"
    assert (done.returncode, done.stderr) == (2, words)


def test_a_table_is_printed_where_not_all_of_its_letters_are_known(monkeypatch):
    written = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", written)
    output.emit("N\u00b2m\u00b2s 1\n", "-")
    written.flush()
    assert written.buffer.getvalue() == b"N?m?s 1\n"


def test_a_folder_that_is_gone_is_said(tmp_path):
    gone = tmp_path / "gone"
    there = f"mkdir {gone}; cd {gone}; rmdir {gone}; jaxpend score --controller pd --json found"
    done = command(there, PYTHONPATH=str(Path(__file__).parents[1]))
    words = "jaxpend score: the current folder is gone; change to one that is there\n"
    assert (done.returncode, done.stderr.endswith(words)) == (2, True)


def test_progress_is_not_among_the_results_where_standard_error_is_closed(monkeypatch, capsys):
    def find(task, search, say):
        say("found")
        report = {"criteria": {"swingup_time": 1.0}, "turns_of_theta2": 0, "score": 0.5}
        return [(None, report)]

    monkeypatch.setattr("jaxpend.trajopt.search.find", find)
    monkeypatch.setattr("sys.stderr", None)
    commands.optimise("pendubot", "jaxpend optimise", json="-")
    assert json.loads(capsys.readouterr().out)["optima"][0]["score"] == 0.5


@pytest.mark.parametrize("columns", ["0", "1", "-5", "wide"])
def test_a_terminal_with_no_room_is_written_beyond(runs, columns):
    for line in ("--help", "train --help", "robustness -H"):
        done = command(f"jaxpend {line}", COLUMNS=columns)
        assert (done.returncode, done.stderr) == (0, "")
        assert "--config" in done.stdout or "--map" in done.stdout
    done = command(f"jaxpend runs {runs}", COLUMNS=columns)
    assert done.returncode == 0
    assert "mine" in done.stderr


def test_a_platform_that_is_not_there_is_said():
    said = {
        ("JAX_PLATFORMS", "nonsense"): "JAX_PLATFORMS is 'nonsense', which jax cannot use here: ",
        ("JAX_PLATFORMS", "cuda"): "JAX_PLATFORMS is 'cuda', which jax cannot use here: ",
        ("JAX_PLATFORM_NAME", "nonsense"): "JAX_PLATFORM_NAME is 'nonsense', which jax cannot use",
        ("JAX_NUM_CPU_DEVICES", "0"): "JAX_NUM_CPU_DEVICES is '0', which jax cannot use here: ",
        ("JAX_NUM_CPU_DEVICES", "x"): "jax does not take a variable of the environment: ",
        ("JAX_ENABLE_X64", "maybe"): "jax does not take a variable of the environment: ",
        ("MPLBACKEND", "x"): "MPLBACKEND is 'x', which matplotlib does not know; leave it unset",
    }
    for (name, value), words in said.items():
        done = command("jaxpend robustness", **{name: value})
        assert done.returncode == 2
        assert done.stderr.startswith(f"jaxpend robustness: {words}")
        assert done.stderr.count("\n") == 1


# The first look at a descriptor comes right after the handler is there.
INTERRUPTED = """
import os
from jaxpend.__main__ import main
look = os.fstat
def ready(descriptor):
    os.fstat = look
    print(flush=True)
    return look(descriptor)
os.fstat = ready
main()
"""


@pytest.mark.parametrize("line", ["score", "train --runs {}"])
@pytest.mark.parametrize("seconds", [0.05, 0.1, 0.2, 0.3, 0.5, 0.8])
def test_ctrl_c_in_the_first_second_is_one_line(tmp_path, line, seconds):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # children inherit "ignored"
    pipe = subprocess.PIPE
    arguments = [sys.executable, "-c", INTERRUPTED, *line.format(tmp_path).split()]
    with subprocess.Popen(arguments, stdout=pipe, stderr=pipe, text=True) as process:
        signal.signal(signal.SIGINT, before)
        process.stdout.readline()
        time.sleep(seconds)
        process.send_signal(signal.SIGINT)
        said = process.stderr.read()
    assert process.returncode == 130
    if "SAC: compiling ..." in said:  # a machine that is so fast says where training stopped
        compiling, stopping, stopped = said.splitlines()
        assert compiling == "SAC: compiling ..."
        assert stopping == "stopping at the end of this step of the loop; once more stops at once"
        begin = "jaxpend train: stopped in SAC at 0 of 600,000 environment steps; everything is in "
        assert stopped.startswith(f"{begin}{tmp_path}")
    else:
        assert said == "jaxpend: interrupted\n"


def test_help_takes_little_time():
    def used():
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    seconds = []
    for line in ("--help", "train --help", "train --help"):
        before = used()
        assert command(f"jaxpend {line}").returncode == 0
        seconds.append(used() - before)
    assert min(seconds) < 0.3


def test_help_shows_choices_and_with_capital_h_what_fields_mean():
    short, full = (command(f"jaxpend train {h}").stdout for h in ("--help", "-H"))
    for text in (short, full):
        assert "--on-divergence stop|rollback (default: stop)" in text
        assert "--snes.strategy snes|sep_cma_es|lm_ma_es|open_es (default: snes)" in text
        assert "--sac.actor-hidden INTEGER ... (default: 128 128)" in text
        assert "--sac.mirror, --sac.no-mirror (default: no)" in text
    about = ("gradient updates per vector step", "Polyak averaging of the target critics")
    assert all(words in full and words not in short for words in about)
    assert "\n\nsac.env: The learning environment:\n" in short


# --- what the commands refuse before they compute ------------------------------------------


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("robustness --keys 0", "--keys is 0; it must be positive"),
        ("robustness --chunk 0", "--chunk is 0; it must be positive"),
        ("robustness --worst -5", "--worst is -5; it must not be negative"),
        ("robustness --seed -1", "--seed is -1; it must not be negative"),
        ("robustness --seed 2147483647", "--seed is 2147483647; it must be below 2,147,483,647"),
        ("robustness --torque-limit nan", "--torque-limit is nan; it must be positive"),
        ("robustness --torque-limit inf", "--torque-limit is inf; it must be finite"),
        ("robustness --map m2", "--map is 'm2'; it must be 2 values, each a text"),
        ("robustness --robot tricycle", "--robot is 'tricycle'; it must be acrobot or pendubot"),
        ("robustness --out {file}", "cannot write into {file}: {file} is not a folder"),
        ("robustness --out {file}/a/b", "cannot write into {file}/a/b: {file} is not a folder"),
        ("robustness --json {folder}", "cannot write {folder}: it is a folder"),
        ("leaderboard --out {folder}", "cannot write {folder}: it is a folder"),
        ("leaderboard --keys 0", "--keys is 0; it must be positive"),
        ("optimise", "--robot is missing; see jaxpend optimise --help"),
        ("optimise --robot acrobot --out {file}/a", "cannot write into {file}: {file} is not a "
         "folder"),
        ("optimise --robot acrobot --search.horizons", "--search.horizons needs a value: one or "
         "more values, each a number"),
        ("optimise --robot acrobot --search.starts -1", "--search.starts is -1; it must be "
         "positive"),
        ("report", "RUN is missing; see jaxpend report --help"),
        ("report acrobot --out {file}", "cannot write into {file}: {file} is not a folder"),
        ("score --json {file}/a", "cannot write into {file}: {file} is not a folder"),
        ("runs {folder} --json {folder}", "cannot write {folder}: it is a folder"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_before_anything_runs(monkeypatch, capsys, tmp_path, line, words):
    (tmp_path / "file").touch()
    names = {"file": tmp_path / "file", "folder": tmp_path}
    line = line.format(**names)
    assert run(monkeypatch, capsys, line, cli.main) == (
        2, "", f"jaxpend {line.split()[0]}: {words.format(**names)}\n",
    )  # fmt: skip


def test_a_folder_that_is_not_writable(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    code, out, err = run(monkeypatch, capsys, f"robustness --out {tmp_path}/new", cli.main)
    words = f"cannot write into {tmp_path}/new: {tmp_path} is not writable\n"
    assert (code, out, err) == (2, "", f"jaxpend robustness: {words}")


def test_optimise_knows_its_command_line():
    line = ["--robot", "acrobot", "--search.starts=8", "--out", "a b"]
    call = cli.parse(commands.optimise, "jaxpend optimise", line)
    assert (
        call.keywords["command"] == "jaxpend optimise --robot acrobot --search.starts=8 --out 'a b'"
    )
    assert call.keywords["search"].starts == 8


def test_judging_on_another_plant(tmp_path, capsys):
    path = tmp_path / "own.yaml"
    path.write_text(json.dumps(designs.parameters("C.1/1.0")))

    def judged(**where):
        commands.score("acrobot", controller="tvlqr", json="-", **where)
        return json.loads(capsys.readouterr().out)

    on_board, by_name, by_file = judged(), judged(design="C.1/1.0"), judged(plant=str(path))
    assert by_name["criteria"] == by_file["criteria"] != on_board["criteria"]
    assert (by_name["design"], by_file["plant"]) == ("C.1/1.0", str(path))
    assert (on_board["controller"], on_board["policy"], on_board["header"]) == (
        "tvlqr",
        None,
        None,
    )


@pytest.mark.parametrize("name", ["score", "robustness", "leaderboard"])
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--plant nothing.yaml", "cannot read nothing.yaml: No such file or directory"),
        ("--design C.9/1.0", "unknown design 'C.9/1.0'; known: A.0/"),
        ("--plant a --design C.1/1.0", "plant a and design C.1/1.0 are both given"),
    ],
)
def test_plants_that_are_not_there(monkeypatch, capsys, name, options, words):
    code, out, err = run(monkeypatch, capsys, f"{name} {options}", cli.main)
    assert (code, out) == (2, "")
    assert err.startswith(f"jaxpend {name}: {words}")
    assert err.count("\n") == 1


def test_a_run_knows_its_plant():
    config = configured("--design", "C.1/1.0", "--robot", "acrobot")
    assert (config.plant, config.design) == ("", "C.1/1.0")

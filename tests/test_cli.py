"""What every command shares: exit codes, one-sentence errors, strict JSON, configuration."""

import json
import math
import signal

import numpy as np
import pytest

from jaxpend import JaxpendError, cli
from jaxpend.config import TrainRun
from jaxpend.interrupt import Stopped


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


def main(robot: str = "pendubot", keys: int = 3, plot: bool = True) -> None:
    """A command."""
    if robot not in ("acrobot", "pendubot"):
        raise JaxpendError(f"unknown robot {robot!r}")
    print(robot, keys, plot)


@pytest.mark.parametrize(
    ("arguments", "code", "out", "err"),
    [
        ("", 0, "pendubot 3 True\n", ""),
        ("--robot acrobot --keys 5 --plot False", 0, "acrobot 5 False\n", ""),
        ("--robot cartpole", 2, "", "prog: unknown robot 'cartpole'\n"),
    ],
)
def test_run_parses_calls_and_exits(monkeypatch, capsys, arguments, code, out, err):
    monkeypatch.setattr("sys.argv", ["prog", *arguments.split()])
    with pytest.raises(SystemExit) as exit_:
        cli.run(main, "prog")
    assert exit_.value.code == code
    assert capsys.readouterr() == (out, err)


@pytest.mark.parametrize("arguments", ["--keis 5", "--keys many"])
def test_unknown_options_and_bad_values_exit_with_2(monkeypatch, capsys, arguments):
    monkeypatch.setattr("sys.argv", ["prog", *arguments.split()])
    with pytest.raises(SystemExit) as exit_:
        cli.run(main, "prog")
    assert exit_.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert arguments.split()[-1] in err or arguments.split()[0] in err
    assert "Traceback" not in err


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


def configured(monkeypatch, arguments):
    """The configuration that a training command makes of its arguments."""
    monkeypatch.setattr("sys.argv", ["prog", *map(str, arguments)])
    return cli.configure(TrainRun(), "prog", "words", also=("policy", "sac", "snes"))


def test_options_override_the_file_which_overrides_the_defaults(monkeypatch, tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("robot: acrobot\nseed: 3\nsac: {discount: 0.9, actor_hidden: [4, 5]}")
    options = ["--config", path, "--seed", 5, "--sac.env.reward.line", 0.4]
    config = configured(monkeypatch, options)
    assert (config.robot, config.seed, config.sac.discount) == ("acrobot", 5, 0.9)
    assert config.sac.actor_hidden == (4, 5)
    assert (config.sac.env.robot, config.sac.env.reward.line) == ("acrobot", 0.4)
    assert config.snes == TrainRun().snes


def test_the_robot_option_reaches_the_environment(monkeypatch):
    config = configured(monkeypatch, ["--robot", "acrobot"])
    assert (config.sac.env.robot, config.sac.env.reward.line) == ("acrobot", 0.375)
    config = configured(monkeypatch, ["--robot", "acrobot", "--sac.env.reward.line", 0.4])
    assert config.sac.env.reward.line == 0.4

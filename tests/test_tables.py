"""The tables of the command line: what they say, and that they fit a terminal of 80 columns."""

import pytest

from jaxpend.boards import HEADINGS, v2
from jaxpend.cli import tables
from jaxpend.robustness import CRITERIA

FAILED = {"score": 0.0, "success": False, "criteria": dict.fromkeys(HEADINGS, 10.0)}
STOOD = {"score": 0.7, "success": True, "criteria": dict.fromkeys(HEADINGS, 1.25)}


@pytest.fixture
def narrow(monkeypatch):
    monkeypatch.setattr(tables.console, "width", 80)


def cells_of(said, start):
    """The cells of the line that starts with a word, behind its first."""
    (line,) = [line for line in said.splitlines() if line.strip(" │┃").startswith(start)]
    return [cell.strip() for cell in line.strip().strip("│").split("│")][1:]


def test_a_failed_run_has_no_swing_up_time(capfd):
    tables.score_table({"a": FAILED, "b": STOOD}, v2("acrobot"))
    said = capfd.readouterr().err
    assert cells_of(said, "swing-up [s]") == ["-", "1.25"]
    assert cells_of(said, "energy [J]") == ["10.00", "1.25"]


def test_results_without_a_later_criterion_have_an_empty_cell(capfd, narrow):
    old = STOOD | {"criteria": {"swingup_time": 1.25}}
    tables.score_table({"a": old}, v2("acrobot"))
    assert cells_of(capfd.readouterr().err, "energy [J]") == [""]
    row = old | {"title": "Old", "source": "measured", "robustness": 0.5}
    tables.leaderboard_table({"rows": [row | {"robustness_criteria": {}}]}, v2("acrobot"))
    lines = [line.split() for line in capfd.readouterr().err.splitlines()]
    assert ["Old", "0.700", "1.25"] in lines
    assert ["Old", "0.500"] in lines


def test_stages_that_look_at_scenarios_say_how_often_it_stands(capfd, narrow):
    robust = STOOD | {"standing": {"before": 0.875, "after": 0.9521}}
    tables.score_table({"after SAC": robust, "after SNES": STOOD}, v2("acrobot"))
    said = capfd.readouterr().err
    assert cells_of(said, "stands [%]") == ["87.5 → 95.2", ""]
    assert max(map(len, said.splitlines())) <= 80
    tables.score_table({"after SNES": STOOD}, v2("acrobot"))
    assert "stands" not in capfd.readouterr().err


def test_the_leaderboard_fits_80_columns(capfd, narrow):
    row = STOOD | {"title": "Policy, network + LQR", "source": "measured", "robustness": 0.5}
    row["robustness_criteria"] = dict.fromkeys(CRITERIA, 0.25)
    tables.leaderboard_table({"rows": [row]}, v2("acrobot"))
    said = capfd.readouterr().err
    assert max(map(len, said.splitlines())) <= 80
    for heading in ("swing-up", "[N²m²s]", "velocity", "[rad²/s]", "response", "Pulses", "all six"):
        assert heading in said
    assert said.count("Policy, network + LQR") == 2


@pytest.mark.parametrize("name", ["pendubot-seed0", "pendubot-snes-seed0"])
def test_the_name_of_a_run_is_not_broken(capfd, narrow, name):
    run = {
        "run": name, "robot": "pendubot", "stages": ["sac", "snes"], "seed": 0, "score": 0.6995,
        "state": "interrupted", "at": "snes 40/100", "seconds": 125,
        "changed": "2026-11-24T23:45:00",
    }  # fmt: skip
    tables.runs_table([run])
    said = capfd.readouterr().err
    for word in (name, "pendubot", "interrupted:", "40/100", "0.6995", "23:45", "date"):
        assert word in said
    assert max(map(len, said.splitlines())) <= 80


def test_the_spread_over_keys_is_a_range_everywhere(capfd):
    result = {
        "simulations": 722, "run_seconds": 1.0, "compile_seconds": 1.0, "overall": 0.55,
        "criteria": {"delay": {"diverged": 0}}, "scores": {"delay": 0.2},
        "over_keys": {"overall": [0.5, 0.6, 0.55], "scores": {"delay": [0.1, 0.2, 0.3]}},
    }  # fmt: skip
    tables.robustness_table(result, v2("acrobot"))
    said = capfd.readouterr().err
    assert cells_of(said, "Time delay")[1] == "10.0 to 30.0"
    assert cells_of(said, "Overall")[1] == "50.0 to 60.0"

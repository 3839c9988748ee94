"""The leaderboard: rows, order, marks, errors; the judging itself is tested where it lives."""

import json
import subprocess
import sys
import types

import pytest

from jaxpend import JaxpendError, designs, leaderboard
from jaxpend.boards import v2
from jaxpend.cli import commands
from jaxpend.controllers import Zero, load_reference, tvlqr
from jaxpend.criteria import V2_OFFICIAL
from jaxpend.robustness import CRITERIA


def test_measured_and_published_rows_in_one_order():
    chosen = {
        "tvlqr": ("TVLQR", lambda plant: tvlqr(plant, load_reference("pendubot"))),
        "zero": ("Nothing", lambda plant: Zero()),
    }
    board = leaderboard.leaderboard(v2("pendubot"), chosen, robustness=False)
    scores = [row["score"] for row in board["rows"]]
    assert scores == sorted(scores, reverse=True)
    first, last = board["rows"][0], board["rows"][-1]
    assert (first["title"], first["source"]) == ("TVLQR", "measured")
    assert first["score"] >= 0.700
    assert first["robustness"] is None
    assert (last["title"], last["success"], last["score"]) == ("Nothing", False, 0.0)
    published = {row["title"]: row for row in board["rows"] if row["source"] == "published"}
    assert (published["TVLQR"]["score"], published["TVLQR"]["robustness"]) == (0.526, 0.767)
    table = leaderboard.markdown(board).splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert table[2].startswith("| TVLQR | 0.700 | 1.27 |")
    assert any(line.startswith("| TVLQR (published) | 0.526 |") for line in table)


def test_robustness_is_part_of_the_row(monkeypatch):
    seen = {}

    found = types.SimpleNamespace(
        overall=0.6, overall_by_key=[0.5, 0.7, 0.6], scores={"model": 1.0, "delay": 0.2}
    )

    def benchmark(controller, board, key, *, keys):
        seen.update(dtype=board.task.plant.mass.dtype, keys=keys)
        return found

    monkeypatch.setattr(leaderboard, "benchmark", benchmark)
    row = leaderboard.judge(lambda plant: Zero(), v2("acrobot"), keys=3)
    assert row["robustness"] == 0.6
    assert row["robustness_criteria"] == {"model": 1.0, "delay": 0.2}
    assert (str(seen["dtype"]), seen["keys"]) == ("float32", 3)
    row = {"title": "Nothing", "source": "measured", "success": False} | row
    row["robustness_criteria"] = dict.fromkeys(CRITERIA, 0.25)
    line = leaderboard.markdown({"columns": V2_OFFICIAL, "rows": [row]}).splitlines()[-1]
    assert line.endswith("| 0.25 | 0.600 (0.500 to 0.700) |")


@pytest.mark.parametrize("robot", designs.ROBOTS)
def test_unknown_names_list_the_known_ones(robot):
    with pytest.raises(JaxpendError, match=r"unknown controller 'foo'; known: .*mpc, mpc_free"):
        commands.leaderboard(robot=robot, controllers="tvlqr,foo")


def test_command_prints_json_only_on_standard_output():
    command = "-m jaxpend.leaderboard --robot acrobot --controllers tvlqr --no-robustness"
    command = [sys.executable, *command.split(), "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = json.loads(done.stdout)["rows"]
    assert rows[0]["name"] == "tvlqr"
    assert rows[0]["criteria"]["tau_smoothness"] < 0.004
    assert "* published" in done.stderr

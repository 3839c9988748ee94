"""Recorded trajectories: the reference's layout in and out, and what is refused."""

import json

import numpy as np
import pytest
from conftest import assert_close, excerpt, refused

from jaxpend import boards, cli
from jaxpend.cli import commands
from jaxpend.interop.csv import HEADER, load_csv, save_csv
from jaxpend.rollout import Trajectory
from jaxpend.score import recorded

ROBOT = "pendubot"


@pytest.fixture(scope="module")
def swing():
    """A run of the reference simulator, in which the pendubot swings up, and its scores."""
    data = excerpt(f"trajectories_{ROBOT}")
    t, x, u = data["swing_T"], data["swing_X"], data["swing_U"]
    run = Trajectory(t=t, x=x, u=u, x_measured=x[:-1], u_command=u)
    scores = {name: float(data[f"swing_score_{name}"]) for name in ("v2_official", "v2_hardware")}
    return run, scores


@pytest.fixture(scope="module")
def file(swing, tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "run.csv"
    save_csv(path, swing[0])
    return path


def test_what_is_written_comes_back(swing, file):
    run, back = swing[0], load_csv(file)
    steps = len(run.u)
    np.testing.assert_array_equal(back.t, run.t[:steps])
    np.testing.assert_array_equal(back.x, run.x[:steps])
    np.testing.assert_array_equal(back.u, run.u)
    with file.open() as text:
        assert text.readline() == "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,tau_con1,tau_con2\n"
    again = file.with_name("again.csv")
    save_csv(again, back)
    save_csv(again, back)  # what it wrote itself it may replace
    assert again.read_bytes() == file.read_bytes()


@pytest.mark.parametrize("hardware", [False, True])
def test_the_score_is_that_of_the_reference(swing, file, capsys, hardware):
    commands.score(ROBOT, csv=str(file), hardware=hardware, json="-")
    result = json.loads(capsys.readouterr().out)
    expected = swing[1]["v2_hardware" if hardware else "v2_official"]
    assert_close(np.array(result["score"]), expected)
    assert 0.3 < expected < 0.9
    assert (result["success"], result["csv"], result["robot"]) == (True, str(file), ROBOT)


def test_other_columns_and_orders(file):
    """Planned trajectories have other names and gains beside; recorded ones filtered states."""
    run = load_csv(file)
    table = np.column_stack([run.u, run.x, run.t, run.t])[:50]
    header = "tau1,tau2, pos1, pos2, vel1 ,vel2,K11,time"
    path = file.with_name("planned.csv")
    np.savetxt(path, table, delimiter=", ", header=header, comments="")
    back = load_csv(path)
    np.testing.assert_array_equal(back.x, run.x[:50])
    np.testing.assert_array_equal(back.u, run.u[:50])
    both = np.column_stack([run.t, run.x, run.u, 0 * run.x, 0 * run.u])[:50]
    np.savetxt(path, both, delimiter=",", header=f"{HEADER},pos1,pos2,vel1,vel2,tau1,tau2",
               comments="")  # fmt: skip
    np.testing.assert_array_equal(load_csv(path).x, run.x[:50])


def test_the_clock_of_a_robot_is_not_exact(swing):
    run = swing[0]
    jitter = np.random.default_rng(0).uniform(-5e-4, 5e-4, len(run.t))
    shaken = run.replace(t=run.t + jitter, u=run.u + np.array([0.0, 0.4]))
    found = recorded(shaken, boards.hardware(ROBOT), regular=False)
    assert found["success"]
    with refused("the run starts at "):
        recorded(shaken, boards.hardware(ROBOT))
    short = Trajectory(*(getattr(run, name)[:3000] for name in ("t", "x", "u")), None, None)
    assert recorded(short, ROBOT)["score"] == 0  # as the boards score what was stopped early


def test_the_clock_of_a_robot_may_begin_anywhere(swing):
    """Time counts from the first stamp, but where that is about 0, as the boards take it."""
    run, board = swing[0], boards.hardware(ROBOT)
    expected = recorded(run, board, regular=False)

    def judged(t, start=0):
        u, x = run.u[start:], run.x[start : len(run.u)]
        return recorded(Trajectory(t[start : len(run.u)], x, u, None, None), board, regular=False)

    for began in (1.6e9, -100.0, 5.0):
        found = judged(run.t + began)
        assert found["score"] == pytest.approx(expected["score"], abs=1e-6)
        assert found["criteria"]["swingup_time"] == pytest.approx(
            expected["criteria"]["swingup_time"], abs=1e-6
        )
    # The second half alone is half a run, and is scored as what was stopped early.
    assert judged(run.t, len(run.u) // 2)["score"] == 0
    near = judged(run.t + 0.05)["criteria"]["swingup_time"]
    assert near == pytest.approx(expected["criteria"]["swingup_time"] + 0.05)
    for t, lasts in ((2 * run.t - 10, "19.99"), (np.linspace(-100, 10, len(run.t)), "109.9")):
        with refused(f"the run lasts {lasts}"):
            judged(t)
    with refused("the run starts at 1.6e+09 s"):
        recorded(run.replace(t=run.t + 1.6e9), ROBOT)


def test_a_run_of_lists_is_judged_as_one_of_arrays(swing):
    run = swing[0]
    lists = Trajectory(*(getattr(run, name).tolist() for name in vars(run)))
    assert recorded(lists, ROBOT) == recorded(run, ROBOT)
    for wrong in (run.replace(t=["a"]), run.replace(x=[[1.0], [1.0, 2.0]]), None):
        with refused("the run cannot be read; it must be a Trajectory"):
            recorded(wrong, ROBOT)
    with refused("the run has t (), "):
        recorded(run.replace(t=None), ROBOT)


ROW = "0,0,0,0,0,0,0\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty; it must have the columns time,pos_meas1"),
        ("\n", "is empty"),
        (HEADER + "\n", "holds 0 samples; a trajectory has three or more"),
        (HEADER + "\n" + 2 * ROW, "holds 2 samples"),
        (HEADER.replace("time,", "") + "\n" + 9 * ROW, "has no column time; it must have the col"),
        (HEADER.replace("vel_meas2,", "") + "\n", "has no column vel_meas2; it must"),
        (HEADER + ",vel_meas1\n", "has the column vel_meas1 twice; which one counts is not clear"),
        ("time,pos1,pos2,vel1,vel2,tau1\n", "has no column tau2; it must"),
        ("0,1,2\n3,4,5\n", "has no column time, pos_meas1, pos_meas2, vel_meas1"),
        (HEADER + "\n" + ROW + "0,0,0\n" + ROW, "line 3 has 3 values for 7 columns; it may be cut"),
        ("\n ,\n" + HEADER + "\n" + ROW + "0,0\n", "line 5 has 2 values for 7 columns"),
        (HEADER + "\n" + ROW + "0,0,x,0,0,0,0\n", "line 3: pos_meas2 is 'x'; it must be a finite"),
        (HEADER + "\n" + ROW + "0,0,0,0,0,0,nan\n", "line 3: tau_con2 is 'nan'; it must be a fin"),
        (HEADER + "\n" + ROW + "0,0,0,inf,0,0,0\n", "line 3: vel_meas1 is 'inf'; it must be a fi"),
        (HEADER + "\n" + ROW + ",0,0,0,0,0,0\n", "line 3: time is ''; it must be a finite number"),
        (HEADER + "\n1" + ROW + 3 * ROW, "time goes back from 10.0 s to 0.0 s"),
        (b"\xff\xfe\x00PK", "is no CSV: it is not text with commas"),
        (HEADER + "\n" + "1" * 200_000, "is no CSV: it is not text with commas"),
        ("{}\n", "has no column time"),
    ],
)  # fmt: skip
def test_what_is_no_trajectory_is_refused(tmp_path, text, words):
    path = tmp_path / "file.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with refused(words, start=str(path)):
        load_csv(path)


def grid(**changes):
    """Hanging still for 10 s."""
    t = 0.002 * np.arange(5000)
    run = Trajectory(t=t, x=np.zeros((5000, 4)), u=np.zeros((5000, 2)), x_measured=None,
                     u_command=None)  # fmt: skip
    return run.replace(**changes)


@pytest.mark.parametrize(
    ("run", "regular", "words"),
    [
        (grid(t=0.001 * np.arange(5000)), True, "has a step of 0.001 s; a simulated run of this"),
        (grid(t=1 + 0.001 * np.arange(5000)), True, "the run starts at 1 s and has"),
        (grid(u=np.ones((5000, 3))), False, "the run has t (5000,), x (5000, 4), u (5000, 3); it"),
        (grid(x=np.zeros((3, 4))), False, "the run has t (5000,), x (3, 4), u (5000, 2); it must"),
        (grid(t=1e300 * np.arange(5000)), False, "the run lasts 4.999e+303 s; a run of this boa"),
        (grid(t=0.01 * np.arange(5000)), False, "the run lasts 49.99 s; a run of this board last"),
        (grid(u=np.ones((5000, 2))), True, "joint 2 has torques of up to 1 N m, but the pendubot"),
        (grid(u=np.tile([0.2, 3.0], (5000, 1))), False, "driven at joint 1; the run is that of an"),
    ],
)
def test_runs_of_something_else_are_refused(run, regular, words):
    with refused(words):
        recorded(run, ROBOT, regular=regular)


# As the reference writes a simulated run.
THEIRS = "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,tau_con1,tau_con2\n" + ",".join(
    ["0.000000000000000000e+00"] * 7
)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--csv none.csv", "cannot read none.csv: No such file or directory"),
        ("--csv .", "cannot read .: Is a directory"),
        ("--csv {run} --robot acrobot", "{run}: joint 1 has torques of up to "),
        ("--csv {run} --policy a", "--csv is a run that is there already; leave out --policy"),
        ("--csv {run} --controller a", "--csv is a run that is there already; leave out --cont"),
        ("--csv {run} --save b", "--csv is a run that is there already; leave out --save"),
        ("--save {other}", "{other} is not a trajectory of jaxpend; name another file"),
        ("--save {theirs}", "{theirs} is not a trajectory of jaxpend; name another file"),
        ("--save -", "a trajectory is written to a file; - is none"),
        ("--save {other}/a", "cannot write into {other}: {other} is not a folder"),
    ],
)
def test_the_command_says_what_is_wrong(file, tmp_path, monkeypatch, capsys, line, words):
    other, theirs = tmp_path / "thesis.csv", tmp_path / "theirs.csv"
    other.write_text("time,pos1\n")
    theirs.write_text(THEIRS)
    names = {"run": file, "other": other, "theirs": theirs}
    monkeypatch.setattr("sys.argv", ["jaxpend", "score", *line.format(**names).split()])
    with pytest.raises(SystemExit) as end:
        cli.main()
    out, err = capsys.readouterr()
    assert (end.value.code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"jaxpend score: {words.format(**names)}")
    assert (other.read_text(), theirs.read_text()) == ("time,pos1\n", THEIRS)


def test_a_run_that_is_saved_scores_the_same(tmp_path, capsys):
    path = tmp_path / "pd.csv"
    scores = []
    for options in ({"controller": "policy_network", "save": str(path)}, {"csv": str(path)}):
        commands.score(ROBOT, json="-", **options)
        scores.append(json.loads(capsys.readouterr().out))
    assert scores[0]["score"] == pytest.approx(scores[1]["score"], rel=1e-12)
    assert scores[0]["criteria"] == pytest.approx(scores[1]["criteria"], rel=1e-12)
    assert scores[0]["score"] > 0.6

"""Charts: what they show of a swing-up and of several seeds."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxpend.plant import tip_height
from jaxpend.report import charts as curves
from jaxpend.report import figures as plots
from jaxpend.runs.statistics import interquartile_mean


@pytest.fixture
def axes():
    return Figure().add_subplot()


def swing(turns=0.0, n=501):
    """Times and states of a smooth way up, and ``turns`` more of joint 2."""
    t = np.linspace(0, 1, n)
    x = np.stack([np.pi * t, 2 * np.pi * turns * t, np.full(n, np.pi), np.sin(t)], axis=1)
    return t, x


def test_angles_are_in_half_turns():
    minus = "\N{MINUS SIGN}"
    names = [f"{minus}3π/2", f"{minus}π", f"{minus}π/2", "0", "π/2", "π", "2π"]
    assert [curves._turns(k * np.pi / 2) for k in (-3, -2, -1, 0, 1, 2, 4)] == names


@pytest.mark.parametrize(("turns", "goal"), [(0, 0), (-1, -2 * np.pi), (7, 14 * np.pi)])
def test_goals_are_the_upright_angles_where_the_arm_ended(axes, turns, goal):
    t, x = swing(turns)
    curves.draw_angles(axes, t, x, end=0.5, up=0.4)
    lines = [line.get_ydata() for line in axes.lines]
    dashed = sorted(line[0] for line in lines if len(line) == 2 and line[0] == line[1])
    assert dashed == pytest.approx(sorted([np.pi, goal]))
    drawn = [line for line in axes.lines if len(line.get_xdata()) > 2]
    np.testing.assert_array_equal(drawn[1].get_ydata(), x[:251, 1])
    assert len(axes.get_yticks()) < 20
    assert axes.get_ylabel() == "angle [rad]"


def test_an_arm_that_spins_without_end_can_be_drawn():
    t, x = swing(1e6)
    angles = plots.svg(plots.panel(curves.draw_angles, t, x, end=1.0), "a", "angles")
    phase = plots.svg(plots.panel(curves.draw_phase, x, joint=1), "b", "phase")
    for drawn in (angles, phase):
        assert drawn.count("<path") > 5
        assert len(drawn) < 1e6


def test_height_and_torque_show_the_line_and_the_limits(axes):
    t, x = swing()
    y = np.asarray(tip_height(np.array([0.2, 0.3]), x))
    curves.draw_height(axes, t, y, reach=0.5, height=0.9, end=1.0)
    assert [line.get_ydata()[0] for line in axes.lines] == pytest.approx([-0.5, 0.45])
    assert axes.lines[0].get_ydata()[-1] == pytest.approx(0.5)
    axes = Figure().add_subplot()
    u = np.stack([0 * t[:-1], 3 * t[:-1]], axis=1)
    curves.draw_torque(axes, t, u, joint=1, limit=6.0, end=1.0)
    assert [line.get_ydata()[-1] for line in axes.lines] == pytest.approx([3 * t[-2], -6, 6])


def test_several_seeds_stay_visible_under_their_interquartile_mean(axes):
    x = np.array([0, 10, 20])
    ys = np.random.default_rng(0).normal(size=(5, 3))
    seeds = [(x, y) for y in ys]
    seeds[2] = (x[:2], ys[2, :2])  # one is not as far
    curves.draw_curves(axes, "Score", {"best": seeds}, xlabel="steps")
    *thin, thick = axes.lines
    assert [len(line.get_xdata()) for line in thin] == [3, 3, 2, 3, 3]
    assert max(line.get_linewidth() for line in thin) < thick.get_linewidth()
    np.testing.assert_array_equal(thick.get_xdata(), x[:2])
    np.testing.assert_allclose(thick.get_ydata(), interquartile_mean(ys[:, :2]))
    (band,) = axes.collections
    low, high = band.get_datalim(axes.transData).intervaly
    assert low < thick.get_ydata().min() < thick.get_ydata().max() < high


def test_noise_does_not_fill_an_axis(axes):
    x, y = np.arange(3), np.array([0.7, 0.7001, 0.7])
    curves.draw_curves(axes, "Score", {"now": [(x, y)]}, xlabel="steps")
    low, high = axes.get_ylim()
    assert high - low == pytest.approx(0.007, rel=0.02)


@pytest.mark.parametrize("y", [[0.0, 0.0], [0.0, 0.1]])
def test_a_logarithmic_axis_needs_something_positive(axes, y):
    curves.draw_curves(axes, "Loss", {"loss": [(np.arange(2), np.array(y))]}, xlabel="x", log=True)
    axes.figure.canvas.draw()
    assert axes.get_yscale() == ("log" if max(y) > 0 else "linear")


def test_a_page_recolours_charts_and_keeps_their_ids_apart():
    def draw(axes):
        axes.plot([0, 1], color=plots.PALETTE["one"])

    first, second = (plots.svg(plots.panel(draw), name, 'a "b" & <c>') for name in "xy")
    assert 'aria-label="a &quot;b&quot; &amp; &lt;c>"' in first
    assert "var(--one)" in first
    assert plots.PALETTE["one"] not in first
    ids = [{part.split('"')[0] for part in text.split('id="')[1:]} for text in (first, second)]
    assert ids[0]
    assert not ids[0] & ids[1]


def test_criteria_and_grids_of_ones_own_are_drawn():
    grids = {
        "delay": {"variation": "delay", "values": [0.0, 0.1], "success": [1.0, 0.0]},
        "delay (2)": {"variation": "delay", "values": [0.2, 0.3], "success": [0.5, 0.0]},
    }
    over = {"overall": [0.25, 0.5, 0.5], "scores": {"mine": [0.25, 0.5, 0.5]}}
    result = {"robot": "acrobot", "overall": 0.5, "scores": {"mine": 0.5}, "over_keys": over}
    bars, strips, _ = plots.robustness_figure(
        [result | {"criteria": {"mine": {"grids": grids}}}]
    ).axes
    assert [text.get_text() for text in bars.get_yticklabels()] == ["Overall", "mine"]
    assert [bar.get_width() for bar in bars.patches] == [0.5, 0.5]
    whiskers = [sorted(line.get_xdata()) for line in bars.lines]
    assert whiskers == [[0.25, 0.5], [0.25, 0.5]]
    assert len(strips.images) == 2


def test_where_a_hand_holds_the_arm_is_shaded(axes):
    t, x = swing()
    curves.draw_velocities(axes, t, x, end=0.5, held=np.array([[0.1, 0.2], [0.4, 0.6], [0.7, 0.8]]))
    bands = [patch.get_extents().transformed(axes.transData.inverted()) for patch in axes.patches]
    found = [(band.x0, band.x1) for band in bands]
    np.testing.assert_allclose(found, [(0.1, 0.2), (0.4, 0.5)], atol=1e-9)

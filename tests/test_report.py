"""The page about a run: what it is made of, what it says, and how it behaves in a browser."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import browser
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxpend import boards, cli, load_policy, resets, save_policy
from jaxpend.boards import Board, v2
from jaxpend.cli import commands
from jaxpend.config import DemonstrationConfig, SACConfig, TrainRun
from jaxpend.config_files import to_mapping
from jaxpend.controllers.policy import network_in
from jaxpend.pytree import pytree
from jaxpend.report import judged, page
from jaxpend.runs import reader as report
from jaxpend.runs.folder import RunFolder, changed
from jaxpend.score import official
from jaxpend.train.loop import stages_of

# Characters that mean something in HTML must not.
NAME = "odd <i> & \"co\""  # fmt: skip
MADE_BY = {"command": "python -m jaxpend.train --seed <7>", "version": "0.0.7"}
SNES = {"mean_fitness": 0.6, "max_fitness": 0.7, "sigma": 0.01}


def sac(steps, score, **more):
    return {"stage": "sac", "env_steps": steps, "score": score, "reward": 1.0, "seconds": 1} | more


def make_run(folder, rows, *, policy="policy.npz", result=True, about=MADE_BY, **config):
    """A run folder as training leaves it, with the policy that ships as its policy."""
    folder.mkdir(parents=True)
    config = TrainRun(robot="pendubot", **config)
    (folder / "config.json").write_text(json.dumps(to_mapping(config)))
    stages = [stage.about() for stage in stages_of(config, None, v2("pendubot").task).values()]
    about = {"stages": stages, "changed": changed(config)} | about
    (folder / "run.json").write_text(json.dumps(about))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    if policy:
        save_policy(folder / policy, load_policy("pendubot"), MADE_BY)
    if result:
        stage = {"score": 0.5, "success": False, "seconds": 61, "criteria": {}}
        (folder / "result.json").write_text(json.dumps({"sac": stage, "score": 0.5}))
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A finished run, and its page with robustness."""
    rows = [sac(0, 0.1), sac(25_000, 0.4, temperature=0.1, critic_loss=None), sac(50_000, 0.3)]
    rows += [{"stage": "snes", "generation": g, "mean_score": 0.35, **SNES} for g in (10, 20)]
    folder = make_run(tmp_path_factory.mktemp("runs") / NAME, rows, seed=4242)
    path = page.write(report.find(folder), folder, title=NAME)
    return SimpleNamespace(folder=folder, path=path, text=path.read_text())


def cells(text, row):
    """Texts of the cells of the table row that has ``row`` in its first cell."""
    for line in re.findall(r"<tr.*?</tr>", text, re.DOTALL):
        found = [re.sub("<[^>]*>", "", cell) for cell in re.findall(r"<t[dh].*?</t[dh]>", line)]
        if found and row in found[0]:
            return found
    raise AssertionError(f"no row {row}")


def test_the_page_says_the_official_score_and_what_costs_it(made):
    truth = official(load_policy("pendubot"), "pendubot")
    assert f"<dd>{truth['score']:.4f}</dd>" in made.text
    rows = ("swing-up", "energy", "torque cost", "smoothness", "velocity cost")
    costs = [float(cells(made.text, row)[-1]) for row in rows]
    assert 1 - sum(costs) == pytest.approx(truth["score"], abs=3e-4)
    assert cells(made.text, "energy")[1] == f"{truth['criteria']['energy']:.2f} J"
    assert cells(made.text, "sum of the costs")[-1] == f"{truth['score']:.4f}"


def test_the_page_ranks_the_run_among_the_published(made):
    board = re.findall(r'<tr( class="own")?><td>(.*?)</td>.*?<td>([\d.]*)</td></tr>', made.text)
    titles = [title for _, title, _ in board]
    assert titles[:2] == ["odd &lt;i&gt; &amp; &#34;co&#34;", "HistorySAC"]
    assert [own for own, _, _ in board[:2]] == [' class="own"', ""]
    measured = json.loads((made.folder / "report" / "pendubot.json").read_text())
    by_key = measured["over_keys"]["overall"]
    assert len(by_key) == 3
    assert "median of 3 keys" in made.text
    assert float(board[0][2]) == pytest.approx(np.median(by_key), abs=6e-4)
    assert cells(made.text, "Time delay")[-1] == f"{100 * measured['scores']['delay']:.1f} %"
    assert cells(made.text, "mean of the six")[-1] == f"{100 * np.median(by_key):.1f} %"


def test_the_policy_that_ships_is_above_every_published_row(made):
    """The acrobot's is in test_robustness.py."""
    best_score, best_robustness = np.max([row[1:] for row in v2("pendubot").published], axis=0)
    measured = json.loads((made.folder / "report" / "pendubot.json").read_text())
    assert measured["simulations"] == 722
    assert measured["overall"] > best_robustness
    assert official(load_policy("pendubot"), "pendubot")["score"] > best_score


def test_the_page_says_how_the_run_was_made(made):
    assert "python -m jaxpend.train --seed &lt;7&gt;" in made.text
    assert "Trained by jaxpend 0.0.7" in made.text
    assert cells(made.text, "seed")[1:] == ["4242", "0"]
    assert "not finished" not in made.text
    assert cells(made.text, "after SAC")[1:] == ["0.5000", "none", "61 s"]


def test_the_page_is_whole_without_a_network(made):
    assert not re.search(r'(src|href)="(?!#|data:)', re.sub(r'xlink:href="#', "", made.text))
    assert not re.search(r"@import|url\((?!#)", made.text)
    assert "<i> &" not in made.text
    # Every chart has words for those who do not see it, and no colour that a page cannot change.
    charts = re.findall(r"<svg [^>]*>", made.text)
    assert len(charts) == 6 + 4 + 8 - 2 + 1
    assert all('role="img"' in chart and 'aria-label="' in chart for chart in charts)
    assert "var(--one)" in made.text.split("</style>", 1)[1]
    assert "#0072b2" not in made.text.split("</style>", 1)[1]


def test_pictures_are_beside_the_page(made):
    folder = made.folder / "report"
    names = {"learning.png", "phase.png", "robustness.png", "swingup.png", "swingup.gif"}
    assert {path.name for path in folder.iterdir()} == names | {"pendubot.json", "pendubot.csv"}
    for name in sorted(names):
        with Image.open(folder / name) as image:
            image.load()
            assert min(image.size) >= 300
            assert len(image.convert("RGB").getcolors(1 << 24)) > 10
    with Image.open(folder / "swingup.gif") as film:
        assert film.n_frames == 3 * 25
        pictures = []
        for frame in (0, 20, 74):
            film.seek(frame)
            pictures.append(np.asarray(film.convert("RGB"), int))
    # It hangs at first, and stands at the end.
    drawn = [np.argwhere(np.ptp(p, axis=2) > 100)[:, 0].mean() / len(p) for p in pictures]
    assert drawn[0] > 0.55
    assert drawn[-1] < 0.45


def test_a_run_that_is_not_finished_shows_what_is_there(tmp_path, capsys):
    folder = make_run(tmp_path / "half", [sac(0, 0.1)], policy="sac_best.npz", result=False)
    with (folder / "metrics.jsonl").open("a") as file:
        file.write('{"stage": "sac", "env_steps": 50')
    commands.report(folder, robustness=False)
    text = (folder / "report.html").read_text()
    words = "half is not finished: SAC is at 0 of 600,000 environment steps, SNES is at 0 of 400"
    assert words in text
    assert words in capsys.readouterr().err
    assert "the best policy so far" in text
    assert "robustness" not in re.sub(r"<style.*?</style>|<thead.*?</thead>", "", text, flags=re.S)


def test_a_run_without_a_policy_has_a_page_too(tmp_path):
    folder = make_run(tmp_path / "young", [], policy=None, result=False)
    commands.report(folder)
    text = (folder / "report.html").read_text()
    assert "there is no policy yet" in text
    assert "<canvas" not in text
    assert not (folder / "report").exists()


def test_seeds_keep_their_axis(tmp_path):
    for seed, score in ((10, 0.4), (2, 0.2)):
        rows = [sac(0, 0.1), sac(25_000, score), sac(50_000, 0.0)]
        make_run(tmp_path / "many" / f"seed{seed}", rows, seed=seed)
    make_run(tmp_path / "many" / "seed1", [sac(0, 0.0)], policy=None, result=False, seed=1)
    runs = report.find(tmp_path / "many")
    assert [run.name for run in runs] == ["seed1", "seed2", "seed10"]
    path = page.write(runs, tmp_path / "out", title="many", robustness=False)
    text = path.read_text()
    truth = official(load_policy("pendubot"), "pendubot")["score"]
    score = f"{truth:.4f}"
    assert cells(text, "seed10")[1] == score
    assert cells(text, "seed10")[-1] == "yes"
    assert [cells(text, "seed1")[k] for k in (1, -1)] == ["", "no"]
    for row in ("median", "interquartile mean"):
        assert cells(text, row)[1] == score
    assert cells(text, "mean of many")[2] == f"{truth:.3f}"
    assert "seed1 is not finished" in text
    assert text.count("<option value=") == 2 + 4


def test_curves_know_the_best_so_far_through_all_stages(made):
    (run,) = report.find(made.folder)
    sac, snes = run.stages
    x, y = page._curve(run, sac, "best")
    assert (x.tolist(), y.tolist()) == ([0, 25_000, 50_000], [0.1, 0.4, 0.4])
    assert page._curve(run, snes, "best")[1].tolist() == [0.4, 0.4]
    assert len(page._curve(run, sac, "temperature")[0]) == 1
    assert len(page._curve(run, sac, "critic_loss")[0]) == 0


def test_what_went_wrong_is_said(tmp_path):
    rows = [{"stage": "imitation", "updates": 20, "loss": 0.1}, sac(0, 0.2)]
    rows += [sac(25, 0.9, finite=0, rollbacks=1), sac(50, 0.1, rollbacks=1)]
    sac_config = SACConfig(demonstrations=DemonstrationConfig(episodes=3, updates=20))
    about = {"command": "jaxpend train --seed 5", "version": "0.9"}
    folder = make_run(tmp_path / "hard", rows, result=False, about=about, sac=sac_config)
    (run,) = report.find(folder)
    first, second = report.remarks([run])
    assert first.startswith(
        "hard is not finished and diverged: Imitation is at 20 of 20 updates, S"
    )
    assert second == "hard diverged and went back to its last good state 1 time."
    # What diverged is no best score.
    assert page._curve(run, run.stages[1], "best")[1].tolist() == [0.2, 0.2]
    assert page._curve(run, run.stages[0], "loss")[1].tolist() == [0.1]
    assert run.made_by["command"] == "jaxpend train --seed 5"


def test_a_run_folder_says_what_differs_from_the_defaults(tmp_path):
    config = TrainRun(robot="acrobot", seed=7, sac=SACConfig(steps=12))
    with RunFolder(tmp_path / "run", config, "jaxpend train"):
        pass
    (run,) = report.find(tmp_path / "run")
    default = to_mapping(SACConfig())["steps"]
    assert run.made_by["changed"] == {"seed": [7, 0], "sac.steps": [12, default]}


def test_rows_that_came_twice_count_once_in_order(tmp_path):
    rows = [sac(50, 0.1), sac(25, 0.2), sac(50, 0.3), {"stage": "else"}, ["no row"]]
    folder = make_run(tmp_path / "resumed", rows)
    found = [(row["env_steps"], row["score"]) for row in report.find(folder)[0].rows]
    assert found == [(25, 0.2), (50, 0.3)]


def test_policies_can_be_shown_without_a_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (shipped,) = report.find(Path("acrobot"))
    assert (shipped.robot, shipped.name, shipped.rows, shipped.config) == ("acrobot",) * 2 + (
        [],
        {},
    )
    save_policy(tmp_path / "mine.npz", load_policy("pendubot"))
    (own,) = report.find(Path("mine.npz"))
    assert (own.robot, own.name) == ("pendubot", "mine")
    commands.report(Path("mine.npz"), robustness=False)
    assert "Learning" not in (tmp_path / "runs" / "mine" / "report.html").read_text()


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda folder: None, "is not a run: give a folder that training has left"),
        (lambda folder: folder.mkdir(), "is not a run: give a folder that training has left"),
        (lambda folder: make_run(folder, []).joinpath("config.json").write_text("{"), "valid JSON"),
        (
            lambda folder: make_run(folder, []).joinpath("config.json").write_text("[]"),
            "is not the",
        ),
        (
            lambda folder: make_run(folder, []).joinpath("run.json").write_text('{"stages": [3]}'),
            "run.json is not what a run says of itself; the run cannot be read",
        ),
        (
            lambda folder: (
                make_run(folder, [])
                .joinpath("run.json")
                .write_text('{"stages": [], "changed": {"seed": 3}}')
            ),
            "run.json is not what a run says of itself; the run cannot be read",
        ),
        (
            lambda folder: make_run(folder, []).joinpath("result.json").write_text('{"score": ""}'),
            "result.json is not the result of a run; the run cannot be read",
        ),
        (lambda folder: make_run(folder, []).joinpath("policy.npz").write_bytes(b""), "cut off"),
        (lambda folder: folder.write_text("text"), "is not a policy file"),
    ],
)
def test_what_is_not_a_run_is_one_sentence(tmp_path, monkeypatch, capsys, prepare, words):
    monkeypatch.chdir(tmp_path)
    prepare(tmp_path / "thing")
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr("sys.argv", ["jaxpend", "report", "thing"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    message = capsys.readouterr().err.strip()
    assert words in message
    assert "\n" not in message
    assert sorted(tmp_path.rglob("*")) == before


def test_a_policy_that_fails_is_shown_failing(tmp_path):
    shipped = network_in(load_policy("pendubot"))
    *hidden, (kernel, bias) = shipped.layers
    pushing = shipped.replace(layers=(*hidden, (0 * kernel, bias + 20)))
    save_policy(tmp_path / "push.npz", pushing)
    commands.report(tmp_path / "push.npz", out=tmp_path, robustness=False)
    text = (tmp_path / "report.html").read_text()
    assert "<dd>0.0000</dd>" in text
    assert "not above the 0.9 line at the end" in text
    assert "The first 10 s" in text


@pytree
class Breaking:
    """Pushes for a while; then it gives what is no number."""

    steps: int

    def reset(self, key):
        return jnp.zeros((), int)

    def __call__(self, step, t, x):
        torque = jnp.where(step < self.steps, jnp.array([6.0, 0.0]), jnp.nan)
        return step + 1, torque


@pytest.mark.parametrize("steps", [0, 7])
def test_a_run_that_diverges_is_shown_as_far_as_it_went(tmp_path, monkeypatch, steps):
    monkeypatch.setattr("jaxpend.report.judged.find_controller", lambda *_, **__: Breaking(steps))
    monkeypatch.setattr("jaxpend.report.judged.read_header", lambda _: {})
    run = report.RunRecord("broken", "pendubot", {}, (), [], None, "pendubot")
    path = page.write([run], tmp_path, title="broken", robustness=False)
    text = path.read_text()
    assert "<dd>0.0000</dd>" in text
    assert "NaN" not in text
    assert "The first 1 s" in text
    film = json.loads(re.search(r'id="film">(.*?)</script>', text).group(1))
    assert len(film["runs"][0]["theta1"]) == steps // 5 + 1
    assert {p.name for p in (tmp_path / "report").iterdir()} >= {"swingup.gif", "swingup.png"}


ODD = ["$x_ a\\b{$^$} %s{{ 1 }}", "\udcff \u4e2d\n\U0001f355"]


@pytest.mark.parametrize("name", ODD, ids=("signs", "not in the font"))
def test_a_name_may_have_any_character(tmp_path, name):
    run = report.RunRecord(name, "pendubot", {}, (), [], None, "pendubot")
    page.write([run], tmp_path, title=name, robustness=False)
    assert (tmp_path / "report" / "swingup.png").exists()


def test_a_run_on_a_plant_of_its_own_is_not_beside_the_published(tmp_path):
    plant = dict(v2("pendubot").task.parameters)
    heavy = {"plant": plant | {"m2": 1.02 * plant["m2"]}}
    folder = make_run(tmp_path / "heavy", [], about=heavy)
    (run,) = report.find(folder)
    text = page.write([run], folder, title="heavy", robustness=False).read_text()
    own = v2("pendubot").task.of(heavy["plant"])
    truth = official(load_policy("pendubot"), Board("own", own))["score"]
    assert f"<dd>{truth:.4f}</dd>" in text
    assert abs(truth - 0.6995) > 1e-4  # the score on the board
    assert "<dt>v2 on a plant of its own</dt>" in text
    assert "official v2" not in text
    assert "HistorySAC" not in text


def test_a_run_of_version_0_1_has_a_page(tmp_path):
    """Its run.json says nothing of its stages."""
    rows = [sac(0, 0.1), sac(25, 0.4, temperature=0.1)]
    rows += [{"stage": "snes", "generation": 9, "mean_score": 0.35, **SNES}]
    folder = make_run(tmp_path / "old", rows)
    (folder / "run.json").write_text('{"version": "0.1.0", "command": "jaxpend train --seed 3"}')
    (run,) = report.find(folder)
    assert page._curve(run, run.stages[0], "best")[1].tolist() == [0.1, 0.4]
    commands.report(folder, robustness=False)
    text = (folder / "report.html").read_text()
    for words in ("jaxpend train --seed 3", "SAC: temperature", "SNES: mean fitness", "after SAC"):
        assert words in text


def test_the_users_matplotlib_stays_as_it_is(tmp_path):
    code = """
import pathlib, sys
import matplotlib
matplotlib.use("pdf")
matplotlib.rcParams["font.size"] = 17
before = dict(matplotlib.rcParams)
import jaxpend.report.page, jaxpend.report.animation, jaxpend.report.charts
import jaxpend.report.figures as figures, jaxpend.report.judged
figures.save(figures.stack([lambda axes: axes.plot([0, 1])]), pathlib.Path(sys.argv[1]))
figures.svg(figures.panel(lambda axes: axes.plot([0, 1])), "a", "a")
assert dict(matplotlib.rcParams) == before
assert matplotlib.get_backend() == "pdf"
"""
    subprocess.run([sys.executable, "-c", code, tmp_path / "a.png"], check=True)
    assert (tmp_path / "a.png").exists()


# --- in a browser --------------------------------------------------------------------------

MOVES = """new Promise(resolve => {
  const clock = document.getElementById('clock'), stage = document.getElementById('stage');
  const time = clock.textContent, picture = stage.toDataURL();
  const look = () => clock.textContent !== time && stage.toDataURL() !== picture
    ? resolve([time, clock.textContent]) : requestAnimationFrame(look);
  look();
})"""
# Where the coloured pixels are, from the top (0) to the bottom (1) of the stage.
COLOURED = """(() => {
  const { width, height } = document.getElementById('stage');
  const pixels = document.getElementById('stage').getContext('2d')
    .getImageData(0, 0, width, height).data;
  let count = 0, sum = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    const [r, g, b, a] = pixels.slice(i, i + 4);
    if (a > 200 && Math.max(r, g, b) - Math.min(r, g, b) > 100) {
      count += 1;
      sum += Math.floor(i / 4 / width) / height;
    }
  }
  return sum / count;
})()"""
# Nothing that should move has moved after this many frames.
FRAMES = """new Promise(resolve => {
  let left = 20;
  const wait = () => left-- ? requestAnimationFrame(wait) : resolve(
    [document.getElementById('clock').textContent, document.getElementById('stage').toDataURL()]);
  wait();
})"""


@pytest.fixture(scope="module")
def tab():
    """A tab of a real browser."""
    if browser.found() is None:
        pytest.skip(f"no browser: none of {', '.join(browser.NAMES)} is installed")
    with browser.chromium() as tab:
        yield tab


def complaints(tab):
    """What the page logged, threw or asked the network for."""
    bad = []
    for method, params in tab.events:
        if method in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
            bad.append(params)
        elif method == "Network.requestWillBeSent":
            url = params["request"]["url"]
            if params["type"] != "Document" and not url.startswith("data:"):
                bad.append(url)
    return bad


def test_the_animation_plays_pauses_and_seeks(made, tab):
    tab.show(made.path)
    before, after = tab.value(MOVES)
    assert before.endswith(" s")
    assert before != after
    assert tab.value("document.getElementById('play').textContent") == "Pause"
    tab.value("document.getElementById('play').click()")
    paused = tab.value(FRAMES)
    assert tab.value(FRAMES) == paused
    seek = "document.getElementById('seek')"
    tab.value(f"{seek}.value = 5; {seek}.dispatchEvent(new Event('input'))")
    assert tab.value("document.getElementById('clock').textContent") == "5.00 s"
    assert complaints(tab) == []  # reading pixels back, as follows, makes the browser complain
    # Upright: above the line, and drawn in the upper half; at first it hangs.
    assert tab.value(COLOURED) < 0.45
    assert tab.value("parseFloat(document.getElementById('height').textContent)") > 0.45
    tab.value(f"{seek}.value = 0; {seek}.dispatchEvent(new Event('input'))")
    assert tab.value(COLOURED) > 0.55


def test_the_page_is_calm_where_motion_is_not_wanted(made, tab):
    tab.show(made.path, features={"prefers-reduced-motion": "reduce"})
    still = tab.value(FRAMES)
    assert tab.value(FRAMES) == still
    assert tab.value("document.getElementById('play').textContent") == "Play"
    tab.value("document.getElementById('play').click()")
    tab.value(MOVES)
    assert complaints(tab) == []


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_a_phone_shows_all_of_it_legibly(made, tab, theme):
    features = {"prefers-color-scheme": theme, "prefers-reduced-motion": "reduce"}
    tab.show(made.path, width=390, height=844, features=features, mobile=True)
    assert tab.value("[innerWidth, document.documentElement.scrollWidth]") == [390, 390]
    tab.value("document.querySelectorAll('details').forEach(e => { e.open = true; })")
    # The smallest text of a chart, in pixels; tables fit without scrolling.
    sizes = """[...document.querySelectorAll('figure svg text')].map(
        text => { const m = text.getScreenCTM();
            return parseFloat(getComputedStyle(text).fontSize) * Math.hypot(m.a, m.b); })"""
    sizes = tab.value(sizes)
    assert len(sizes) > 100
    assert min(sizes) > 9
    wide = (
        "[...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth > e.clientWidth + 1)"
    )
    assert tab.value(f"{wide}.length") == 0
    ink = tab.value("getComputedStyle(document.querySelector('figure svg text')).fill")
    assert ink == {"light": "rgb(26, 29, 33)", "dark": "rgb(233, 235, 238)"}[theme]
    broken = "[...document.images].filter(i => !i.complete || !i.naturalWidth).length"
    assert tab.value(broken) == 0
    assert complaints(tab) == []


def test_a_page_that_fails_is_noticed(made, tab, tmp_path):
    broken = tmp_path / "report.html"
    shutil.copy(made.path, broken)
    text = made.text.replace(
        '"use strict";', 'fetch("https://example.org/x").catch(() => 0); oops();'
    )
    broken.write_text(text.replace("default-src 'none';", "default-src *;"))
    tab.show(broken)
    found = json.dumps(complaints(tab))
    assert "oops is not defined" in found
    assert "https://example.org/x" in found


def test_the_page_on_real_robots_shows_which_of_them_stand(tmp_path, monkeypatch):
    board = dataclasses.replace(boards.HARDWARE["pendubot"], draws=2)
    monkeypatch.setitem(boards.HARDWARE, "pendubot", board)
    monkeypatch.setattr(judged, "ROBOTS_JUDGED", 12)
    commands.report(Path("hardware_pendubot"), out=tmp_path)
    text = (tmp_path / "report.html").read_text()
    assert "12 robots, tried twice" in text
    kept = json.loads((tmp_path / "report" / "identified_pendubot.json").read_text())
    for name, found in kept["conditions"].items():
        row = rf"<td>{name}</td><td>{100 * found['success']:.1f} %</td>"
        assert re.search(row, text)
    assert text.count('<th scope="row">delay [s]</th>') == 1
    assert "the robot of seed 0" in text
    assert "mean of 2 draws" in text
    with Image.open(tmp_path / "report" / "identified_pendubot.png") as picture:
        assert picture.width > 500


def test_the_page_on_the_global_board_shows_when_the_arm_is_held():
    board = boards.V3["acrobot"]
    shown = judged.held(board)
    assert shown.shape == (15, 2)
    steps = np.arange(board.task.steps)
    by_hand = np.asarray(resets.held(board.drawn(0).resets, steps).any(axis=-1))
    within = (steps[:, None] >= shown[:, 0] / 0.002 - 0.5) & (
        steps[:, None] < shown[:, 1] / 0.002 - 0.5
    )
    np.testing.assert_array_equal(within.any(axis=1), by_hand)
    assert judged.held(v2("acrobot")).shape == (0, 2)

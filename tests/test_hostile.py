"""What a hostile user may say to the commands: refused in one sentence, before anything happens."""

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxpend
from jaxpend import cli, designs
from jaxpend.files import write_atomically

CONTROLLERS = """
import jax.numpy as jnp
from jaxpend.pytree import pytree

def raises(t, x): raise ValueError("no\\nway")
def exits(t, x): raise SystemExit(3)
def text(t, x): return "torque"
def three(t, x): return [1, 2, 3]
def complex_(t, x): return 1j
def endless(t, x): return endless(t, x)
def generator(t, x): yield 1
def no_arguments(): return 0
def later(t, x): return [0, 0] if t == 0 else exits(t, x)
number = 3
class Attributes:
    def __getattr__(self, name): raise RuntimeError("attribute")
attributes = Attributes()
@pytree
class Shape:
    def reset(self, key): return jnp.zeros(1)
    def __call__(self, carry, t, x): return carry, jnp.zeros(3)
@pytree
class Leaves:
    def reset(self, key): raise SystemExit("bye")
    def __call__(self, carry, t, x): return carry, jnp.zeros(2)
shape, leaves = Shape(), Leaves()
"""
YAML = {
    "list": "[1, 2]",
    "deep": "[" * 1000,
    "self": "&a [*a]",
    "inside": "sac: &a\n  env: *a\n",
    "tag": "!!python/object/apply:os.system ['true']",
    "two": "seed: 1\n---\nseed: 2\n",
    "key": "1: 2\n",
    "null": "sac:\n",
    "text": "sac: é\n",
    "date": "seed: 2020-01-01\n",
    "huge": f"seed: 1{'0' * 400}\n",
    "line": '"a\\nb": 1\n',
}


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """A folder of files that are not what a command wants."""
    folder = tmp_path_factory.mktemp("template")
    for name, content in YAML.items():
        (folder / f"{name}.yaml").write_text(content)
    (folder / "bytes").write_bytes(bytes(range(256)))
    (folder / "empty").touch()
    (folder / "package.json").write_text('{"name": "mine"}')
    (folder / "own.py").write_text(CONTROLLERS)
    (folder / "leaves_module.py").write_text("raise SystemExit(0)")
    (folder / "broken_module.py").write_text("def f(:")
    for name, changes in PLANTS.items():
        said = {**designs.parameters("C.1/1.0"), **changes}
        (folder / f"plant_{name}.yaml").write_text(json.dumps(said).replace("Infinity", ".inf"))
    shipped = Path(jaxpend.__file__).parent / "policies"
    whole = (shipped / "acrobot.npz").read_bytes()
    (folder / "acrobot_file.npz").write_bytes(whole)
    (folder / "cut.npz").write_bytes(whole[: len(whole) // 2])
    np.savez(folder / "pickled.npz", header=np.array({"a": 1}, dtype=object))
    with np.load(shipped / "acrobot.npz") as file:
        arrays = dict(file)
    (folder / "drawn/report").mkdir(parents=True)
    (folder / "drawn/report/swingup.png").write_bytes(b"\x89PNG mine")
    (folder / "pendubot").write_bytes(b"PK mine")
    for name in ("site/report.html", "results/pendubot.csv", "results/identified_pendubot.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("mine")
    header = json.loads(str(arrays["header"])) | {"provenance": [1]}
    np.savez(folder / "provenance.npz", **arrays | {"header": np.array(json.dumps(header))})
    old = '{"robot": "acrobot"}'
    for name, content in (("junk", "{"), ("none", "[]"), ("old", old), ("group/seed1", old)):
        (folder / "runs" / name).mkdir(parents=True)
        (folder / "runs" / name / "config.json").write_text(content)
    return folder


PLANTS = {
    "text": {"m1": "heavy"},
    "list": {"m1": [1]},
    "flag": {"m1": True},
    "none": {"m1": None},
    "large": {"m1": 10**400},
    "infinite": {"I1": float("inf")},
    "damping": {"b1": -1},
    "rotor": {"Ir": -1},
    "limit": {"tl1": -1},
    "zero": {"l1": 0},
}
EMPTY = "''; it must not be empty"
CASES = [
    # Empty words, as of a shell variable that is not set.
    (["score", "--policy", ""], f"--policy is {EMPTY}"),
    (["score", "--controller="], f"--controller is {EMPTY}"),
    (["score", "--plant", ""], f"--plant is {EMPTY}"),
    (["score", "--design", ""], f"--design is {EMPTY}"),
    (["score", "--json", ""], f"--json is {EMPTY}"),
    (["robustness", "--out", ""], f"--out is {EMPTY}"),
    (["leaderboard", "--policy", ""], f"--policy is {EMPTY}"),
    (["leaderboard", "--controllers", ","], "there is no controller to judge; known: policy, "),
    (["report", ""], f"RUN is {EMPTY}"),
    (["report", "acrobot", "--out", ""], f"--out is {EMPTY}"),
    (["runs", ""], f"FOLDER is {EMPTY}"),
    (["optimise", "--robot", "acrobot", "--out", ""], f"--out is {EMPTY}"),
    # Words that are not in the language, or in another alphabet.
    ("score -- acrobot", "unexpected argument 'acrobot'; see jaxpend score --help"),
    ("score --", ""),
    ("train ---", "unknown option ---; see jaxpend train --help"),
    ("train --sac..env.dt 1", "unknown option --sac..env.dt; did you mean --sac.env.dt?"),
    ("train --SEED 1", "unknown option --SEED; see jaxpend train --help"),
    ("train --seed=1=2", "--seed is '1=2'; it must be an integer"),
    (["robustness", "--keys", "1\u200b"], "--keys is '1\\u200b'; it must be an integer"),
    (["score", "--json", "a\0b"], r"--json is 'a\x00b'; it must hold no null character"),
    (["runs", "a\nb"], r"there is no folder a\nb; jaxpend train makes runs"),
    (["runs", "\x1b[2J"], r"there is no folder \x1b[2J; jaxpend train makes runs"),
    (["score", "--controller", "own\nx:f"], r"cannot load own\nx:f as module:name: "),
    # Numbers that would fill the memory or the disk.
    ("sac --seeds 2147483647", "--seeds is 2147483647; it must be at most 1,000"),
    ("optimise --robot acrobot --search.horizon 1e9", "--search.horizon is 1000000000.0; it must "
     "be at most 3,600"),
    # Policies.
    ("score --policy .", ". is not a policy file, or it is empty or cut off"),
    ("score --policy empty", "empty is not a policy file"),
    ("report cut.npz", "cut.npz is not a policy file"),
    ("snes --policy pickled.npz", "pickled.npz is not a policy file"),
    ("leaderboard --policy bytes", "bytes is not a policy file"),
    ("robustness --policy acrobot_file.npz", "acrobot_file.npz is a controller for the acrobot"),
    ("score --robot acrobot --policy provenance.npz", "provenance.npz is not a policy file: its"),
    ("score --robot acrobot --controller tvlqr --policy acrobot_file.npz", "tvlqr is not built "
     "around a policy; leave out acrobot_file.npz"),
    ("snes --controller tvlqr --policy acrobot_file.npz", "acrobot_file.npz is a controller for "
     "the acrobot"),
    # Controllers of their own.
    ("score --controller :", "cannot load : as module:name: ValueError: Empty module name"),
    ("score --controller own:number", "int is no controller"),
    ("score --controller own:Shape", "Shape is a class, not an instance of it"),
    ("score --controller own:shape", "Shape returns a torque of shape (3,); it must be (2,)"),
    ("score --controller own:leaves", "Leaves cannot be called: SystemExit: bye at "),
    ("score --controller own:attributes", "cannot load own:attributes as module:name: "
     "RuntimeError: attribute at "),
    ("score --controller own:raises", "raises cannot be called: ValueError: no at "),
    ("snes --controller own:exits", "exits cannot be called: SystemExit: 3 at "),
    ("robustness --controller own:text", "text cannot be called: ValueError: could not convert"),
    ("score --controller own:three", "three returns a torque of shape (3,); it must be (2,)"),
    ("score --controller own:complex_", "complex_ cannot be called: TypeError: "),
    ("score --controller own:endless", "endless cannot be called: RecursionError: maximum"),
    ("score --controller own:generator", "generator cannot be called: TypeError: "),
    ("gradient --controller own:no_arguments", "no_arguments cannot be called: TypeError: "),
    ("score --controller leaves_module:f", "cannot load leaves_module:f as module:name: "
     "SystemExit: 0 at "),
    ("score --controller broken_module:f", "cannot load broken_module:f as module:name: "
     "SyntaxError: invalid syntax at "),
    # Plants.
    ("score --plant plant_text.yaml", "plant_text.yaml: plant parameter m1 is 'heavy'; it must be "
     "a number"),
    ("robustness --plant plant_list.yaml", "plant_list.yaml: plant parameter m1 is [1]; it must"),
    ("leaderboard --plant plant_flag.yaml", "plant_flag.yaml: plant parameter m1 is True; it must"),
    ("sac --plant plant_none.yaml", "plant_none.yaml: plant parameter m1 is None; it must be"),
    ("train --plant plant_large.yaml", "plant_large.yaml: plant parameter m1 is 1000"),
    ("score --plant plant_infinite.yaml", "plant_infinite.yaml: plant parameter I1 is inf; it "
     "must be finite"),
    ("score --plant plant_damping.yaml", "plant_damping.yaml: plant parameter b1 is -1.0; it must "
     "not be negative"),
    ("score --plant plant_rotor.yaml", "plant_rotor.yaml: plant parameter Ir is -1.0; it must not"),
    ("score --plant plant_limit.yaml", "plant_limit.yaml: plant parameter tl1 is -1.0; it must"),
    ("score --plant plant_zero.yaml", "plant_zero.yaml: plant parameter l1 is 0.0; it must be pos"),
    ("score --plant deep.yaml", "deep.yaml is nested too deeply, or holds itself"),
    ("score --plant self.yaml", "self.yaml: plant parameters must be a mapping"),
    ("score --plant .", "cannot read .: Is a directory"),
    # Files of others are not written over.
    ("optimise --robot pendubot --out acrobot_file.npz",
     "cannot write acrobot_file.npz: it is there and is no trajectory file"),
    ("robustness --controller pd --out results",
     "cannot write results/pendubot.csv: it is there and is something else"),
    ("hardware --controller pd --out results",
     "cannot write results/identified_pendubot.png: it is there and is something else"),
    ("report acrobot_file.npz --out site",
     "cannot write site/report.html: it is there and is something else"),
    ("report acrobot_file.npz --out drawn",
     "cannot write drawn/report: it is there and is something else"),
    ("optimise --robot pendubot --out pendubot",
     "cannot write pendubot: it is there and is no trajectory file"),
    ("import own.py --robot pendubot --preset evolsac --out pendubot",
     "cannot write pendubot: it is there and is no policy file"),
    ("identify own.py --out new --json new", "--json and --out are both new; name two files"),
    ("runs runs --json package.json", "cannot write package.json: it is there and is something"),
    ("score --controller pd --json runs/old/config.json",
     "cannot write runs/old/config.json: it is there and is something else"),
    ("hardware --controller pd --json package.json", "cannot write package.json: it is there and"),
    ("leaderboard --json - --out -", "--json and --out are both standard output; name a file"),
    ("robustness --controller pd --out new --json new/pendubot.csv",
     "--json and --out are both new/pendubot.csv; name two files"),
    ("hardware --controller pd --out new --json new/identified_pendubot.png",
     "--json and --out are both new/identified_pendubot.png; name two files"),
    # Configurations.
    ("sac --config .", "cannot read .: Is a directory"),
    ("sac --config bytes", "bytes is not valid YAML"),
    ("sac --config list.yaml", "list.yaml must hold fields of SACRun: robot, "),
    ("sac --config deep.yaml", "deep.yaml is nested too deeply, or holds itself"),
    ("sac --config self.yaml", "self.yaml must hold fields of SACRun: robot, "),
    ("sac --config inside.yaml", "inside.yaml: sac.env.env is unknown; known: "),
    ("sac --config tag.yaml", "tag.yaml is not valid YAML, line 1"),
    ("sac --config two.yaml", "two.yaml is not valid YAML, line 2"),
    ("sac --config key.yaml", "key.yaml: 1 is unknown; known: "),
    ("sac --config null.yaml", "null.yaml: sac must hold fields of SACConfig: "),
    ("sac --config text.yaml", "text.yaml: sac must hold fields of SACConfig: "),
    ("sac --config date.yaml", "date.yaml: seed is datetime.date(2020, 1, 1); it must be an"),
    ("sac --config huge.yaml", "huge.yaml: seed is 1000"),
    ("sac --config line.yaml", r"line.yaml: a\nb is unknown; known: "),
    # Folders of runs.
    ("runs own.py", "there is no folder own.py; jaxpend train makes runs"),
    ("report runs", "runs is not a run: give a folder"),
    ("report runs/junk", "runs/junk/config.json is not valid JSON; the run cannot be read"),
    ("report runs/none", "runs/none/config.json is not the configuration of a run; the run"),
    ("sac --runs own.py", "cannot use own.py/pendubot-sac-seed0: Not a directory"),
    ("sac --runs runs --run old", "runs/old holds a run of jaxpend (unknown version), this is "),
    ("sac --runs . --run runs --seeds 2", "runs is not empty and holds no runs of several seeds"),
    ("sac --runs runs --run group --seeds 2", "runs/group/seed1 holds a run of jaxpend (unknown"),
    ("sac --runs . --run .", ". is not empty and holds no run; choose another name"),
]  # fmt: skip


def snapshot(folder):
    """Names, times and sizes of all that is in a folder."""
    return {
        path: (path.lstat().st_mtime_ns, path.lstat().st_size)
        for path in folder.rglob("*")
        if "__pycache__" not in path.parts
    }


@pytest.fixture
def place(template, tmp_path, monkeypatch):
    """A copy of ``template`` as the working directory; whatever would compute there fails."""
    here = tmp_path / "here"
    shutil.copytree(template, here)
    monkeypatch.chdir(here)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in ("own", "leaves_module", "broken_module"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return here


@pytest.mark.parametrize(("line", "words"), CASES, ids=[str(line) for line, _ in CASES])
def test_what_is_hostile_is_refused(place, monkeypatch, capsys, line, words):
    computed = []
    for name in ("score.trial_run", "robustness.benchmark", "train.loop.train_group"):
        monkeypatch.setattr(f"jaxpend.{name}", lambda *_, **__: computed.append(1) or {}[""])
    words_of_line = line if isinstance(line, list) else line.split()
    monkeypatch.setattr("sys.argv", ["jaxpend", *words_of_line])
    before = snapshot(place)
    if not words:  # what is fine after all
        with pytest.raises(KeyError):
            cli.main()
        assert computed
        return
    with pytest.raises(SystemExit) as end:
        cli.main()
    out, err = capsys.readouterr()
    assert err.startswith(f"jaxpend {words_of_line[0]}: {words}")
    assert (end.value.code, out, err.count("\n"), err[-1]) == (2, "", 1, "\n")
    assert "\x1b" not in err
    assert snapshot(place) == before
    assert not computed


def test_a_function_that_fails_in_the_loop_is_one_sentence(place, monkeypatch, capsys, caplog):
    line = ["jaxpend", "score", "--controller", "own:later", "--json", "new.json"]
    monkeypatch.setattr("sys.argv", line)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    out, err = capsys.readouterr()
    words = f"jaxpend score: later cannot be called: SystemExit: 3 at {place / 'own.py'}:6\n"
    assert (out, err) == ("", words)
    assert not caplog.records
    assert not (place / "new.json").exists()


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "ask for less"),
        (MemoryError("Unable to allocate 745 GiB"), "Unable to allocate 745 GiB"),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory\nand more"), "RESOURCE_EXHAUSTED: Out of "
         "memory"),
    ],
)  # fmt: skip
def test_too_little_memory_is_one_sentence(capsys, error, words):
    with pytest.raises(SystemExit) as end, cli.one_sentence("prog"):
        raise error
    assert end.value.code == 2
    assert capsys.readouterr().err == f"prog: there is too little memory: {words}\n"
    with pytest.raises(RuntimeError, match="a bug"), cli.one_sentence("prog"):
        raise RuntimeError("a bug")


def test_brackets_in_a_name_are_no_markup(place, monkeypatch, capsys):
    (place / "[").mkdir()
    shutil.copy("acrobot_file.npz", "[/b].npz")
    monkeypatch.setattr("jaxpend.terminal.console._file", None)
    monkeypatch.setattr(
        "sys.argv", ["jaxpend", "score", "--robot", "acrobot", "--policy", "[/b].npz"]
    )
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    assert "[/b].npz" in capsys.readouterr().err


def test_a_pipe_is_written_to_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_atomically(pipe, "text")
    assert os.read(reader, 10) == b"text"
    os.close(reader)
    assert pipe.is_fifo()
    ends = os.pipe()
    write_atomically(f"/dev/fd/{ends[1]}", "text")
    assert os.read(ends[0], 10) == b"text"
    for end in ends:
        os.close(end)


def test_a_plant_may_have_numbers_as_yaml_has_them(tmp_path):
    path = tmp_path / "plant.yaml"
    said = designs.parameters("C.1/1.0") | {"b1": "1e-3"}  # for YAML it is a text without a point
    path.write_text(json.dumps(said))
    assert designs.read(path) == said | {"b1": 1e-3}


def test_a_leaderboard_goes_to_standard_output(capsys):
    cli.commands.emit("| a |\n", "-")
    assert capsys.readouterr().out == "| a |\n"


def refused(monkeypatch, capsys, *words):
    """What a command says that ends with 2."""
    monkeypatch.setattr("sys.argv", ["jaxpend", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    out, err = capsys.readouterr()
    assert (end.value.code, out, err.count("\n")) == (2, "", 1)
    return err


TRAJECTORY = "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,tau_con1,tau_con2\n"
# A file of a user, and a command that would write another one there.
OVERWRITTEN = [
    ("script.py", "import jaxpend\n", "export acrobot_file.npz --to numpy --out"),
    ("robot.h", "/* with jaxpend */\n", "export acrobot_file.npz --to c --out"),
    ("notes", "jaxpend.interop.numpy\n", "export acrobot_file.npz --to onnx --out"),
    ("run.csv", TRAJECTORY, "score --json"),
    ("run.csv", TRAJECTORY, "robustness --json"),
    ("run.csv", TRAJECTORY, "runs runs --json"),
    ("notes.md", "# Notes\n", "leaderboard --json"),
    ("notes.md", "# Notes\n", "leaderboard --out"),
    ("notes.md", "# Notes\n", "optimise --robot acrobot --out"),
    ("run.csv", TRAJECTORY + "0.0e+00,1.0e+00,0,0,0,0,0\n", "score --save"),
]


@pytest.mark.parametrize(("name", "text", "line"), OVERWRITTEN)
def test_a_file_of_another_kind_is_not_overwritten(place, monkeypatch, capsys, name, text, line):
    for module in ("score.nominal", "robustness.benchmark", "trajopt.search.find"):
        monkeypatch.setattr(f"jaxpend.{module}", lambda *_, **__: pytest.fail("it computed"))
    (place / name).write_text(text)
    said = refused(monkeypatch, capsys, *line.split(), name)
    assert name in said
    assert (place / name).read_text() == text


@pytest.mark.parametrize(
    "line",
    [
        "score --save same --json ./same",
        "leaderboard --json same --out same",
        "optimise --robot acrobot --json same --out same",
    ],
)
def test_one_file_is_not_named_for_two_things(place, monkeypatch, capsys, line):
    said = refused(monkeypatch, capsys, *line.split())
    assert "are both " in said
    assert not (place / "same").exists()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("score --policy /dev/zero", "/dev/zero is not a policy file"),
        ("score --plant /dev/zero", "/dev/zero is not valid YAML"),
        ("import /dev/zero --robot acrobot --preset evolsac --out new.npz", "/dev/zero is not a "
         "model"),
    ],
)  # fmt: skip
def test_a_device_without_an_end_is_not_read(place, monkeypatch, capsys, line, words):
    monkeypatch.setattr(Path, "read_bytes", lambda _: pytest.fail("it would never end"))
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: pytest.fail("it would never end"))
    monkeypatch.setattr("zipfile.ZipFile", lambda *_: pytest.fail("it would never end"))
    assert words in refused(monkeypatch, capsys, *line.split())


def test_an_interrupt_in_a_function_of_a_user_is_one(capsys):
    text = "INTERNAL: CpuCallback error\nTraceback (most recent call last):\nKeyboardInterrupt: "
    with pytest.raises(SystemExit) as end, cli.one_sentence("prog"):
        raise RuntimeError(text)
    assert end.value.code == 130
    assert capsys.readouterr().err == "prog: interrupted\n"

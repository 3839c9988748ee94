"""The tutorial runs as it is, in its short form."""

import re
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parent.parent / "experiments" / "tutorial.py"


def test_the_tutorial_runs_and_says_what_it_promises(tmp_path):
    line = [sys.executable, "-W", "error::UserWarning", SCRIPT, "--short"]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    scores = re.findall(r"v2 score (0\.\d+)", done.stdout)
    assert all(0.4 < float(score) < 0.75 for score in scores)
    assert len(scores) >= 3
    before, after = re.search(r"by hand: v2 score (\S+); .* found: (\S+)", done.stdout).groups()
    assert float(after) > float(before) + 0.02
    assert (tmp_path / "build" / "tutorial" / "swingup.png").stat().st_size > 10_000


def test_the_tutorial_imports_public_names_only():
    text = SCRIPT.read_text()
    assert not re.search(r"import .*\b_\w+|\.\b_\w+\(", text)
    assert text.count("\n# %% ") >= 8

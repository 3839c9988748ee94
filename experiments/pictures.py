"""Remake the pictures of the README: the sentence, and a run's report as a browser shows it.

    python experiments/pictures.py              # sentence.svg
    python experiments/pictures.py pendubot     # report.png and swingup.gif too; needs chromium

The argument is a run folder, or acrobot or pendubot for the policy that ships with the package.
The pictures are in experiments/pictures.
"""

import argparse
import io
import shutil
import subprocess
import tempfile
from pathlib import Path

from PIL import Image

from jaxpend.cli import commands
from jaxpend.files import write_atomically

HERE = Path(__file__).parent / "pictures"
STYLE = """
svg { --ink: #1a1d21; --muted: #5d6570; --edge: #b9c0c9; --box: #f6f7f9; --own: #0072b2 }
@media (prefers-color-scheme: dark) {
  svg { --ink: #e9ebee; --muted: #a6adb8; --edge: #4d5661; --box: #1c2128; --own: #56b4e9 }
}
text { font: 14px system-ui, sans-serif; fill: var(--muted); text-anchor: middle }
text.name { font-weight: 650; font-size: 16px; fill: var(--ink) }
rect { fill: var(--box); stroke: var(--edge); stroke-width: 1.2; rx: 9px }
rect.own { stroke: var(--own); stroke-width: 2 }
path { fill: none; stroke: var(--muted); stroke-width: 1.6; marker-end: url(#tip) }
marker path { fill: var(--muted); stroke: none; marker-end: none }
"""
# Class, left, top, width, height, name, and what it is.
BOXES = (
    ("", 6, 6, 232, 104, "scenario", "noise, delay, pulses, ..."),
    ("", 22, 60, 200, 40, "plant", "masses, lengths, motor"),
    ("own", 6, 124, 232, 50, "controller", "time, measured state → torque"),
    ("", 304, 65, 124, 50, "rollout", "one closed loop"),
    ("", 476, 65, 148, 50, "trajectory", "states and torques"),
    ("own", 672, 65, 112, 50, "score", "from 0 to 1"),
)
ARROWS = ("M240 58 C275 58 268 82 298 82", "M240 149 C275 149 268 98 298 98", "M430 90 H470",
          "M626 90 H666")  # fmt: skip


def sentence() -> str:
    """A controller, put into a scenario, gives a trajectory, and a trajectory gets a score: SVG."""
    parts = [f'<path d="{arrow}"/>' for arrow in ARROWS]
    for kind, x, y, width, height, name, what in BOXES:
        place = f'x="{x}" y="{y}" width="{width}" height="{height}"'
        parts.append(f'<rect class="{kind}" {place}/>')
        middle, top = x + width / 2, y + {40: 16, 50: 21, 104: 19}[height]
        parts.append(f'<text class="name" x="{middle}" y="{top}">{name}</text>')
        parts.append(f'<text x="{middle}" y="{top + 18}">{what}</text>')
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 790 180" width="790" height="180">'
        f"<style>{STYLE}</style>"
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="6"'
        ' markerHeight="6" orient="auto"><path d="M0 0 L8 4 L0 8 z"/></marker></defs>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def seen(page: Path, width: int, height: int) -> Image.Image:
    """The top of a page, without motion, as a picture."""
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        subprocess.run(
            [
                "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
                "--hide-scrollbars", "--force-prefers-reduced-motion",
                f"--user-data-dir={folder}/profile", f"--window-size={width},{height}",
                f"--screenshot={shot}", page.resolve().as_uri(),
            ],
            check=True, capture_output=True,
        )  # fmt: skip
        return Image.open(io.BytesIO(shot.read_bytes())).convert("RGB")


def main() -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, nargs="?")
    run = parser.parse_args().run
    write_atomically(HERE / "sentence.svg", sentence())
    if run is None:
        return
    with tempfile.TemporaryDirectory() as folder:
        commands.report(run, out=Path(folder))
        buffer = io.BytesIO()
        top = seen(Path(folder) / "report.html", 1180, 1240)
        top.quantize(64).save(buffer, "PNG", optimize=True)
        write_atomically(HERE / "report.png", buffer.getvalue())
        shutil.copy(Path(folder) / "report" / "swingup.gif", HERE / "swingup.gif")


if __name__ == "__main__":
    main()

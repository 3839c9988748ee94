"""Remake the pictures of the README from a run: its report, seen by a browser, and its swing-up.

    make train ROBOT=pendubot && python experiments/pictures.py runs/pendubot-seed0

writes experiments/pictures/report.png and swingup.gif. Needs chromium.
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
    """Write the report and take its pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    run = parser.parse_args().run
    commands.report(run)
    buffer = io.BytesIO()
    seen(run / "report.html", 1180, 1240).quantize(64).save(buffer, "PNG", optimize=True)
    write_atomically(HERE / "report.png", buffer.getvalue())
    shutil.copy(run / "report" / "swingup.gif", HERE / "swingup.gif")


if __name__ == "__main__":
    main()

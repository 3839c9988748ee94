"""The pendulum in motion: numbers for the page that plays it, and a GIF."""

import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..files import write_atomically
from .figures import PALETTE
from .judged import Judged

__all__ = ["frame", "gif", "keyframes"]

EVERY = 5  # of the 500 Hz samples the page plays one in five
# Of the GIF.
SIZE = 320  # pixels on a side
RATE = 25  # frames per second
TRAIL = 0.6  # s


def keyframes(judged: Judged) -> dict[str, Any]:
    """What the page needs to play a run, thinned out and rounded."""
    t, x, u = judged.t, judged.x, judged.u[:, judged.task.joint]
    picked = np.arange(0, len(t), EVERY)
    torque = np.append(u, u[-1:] if len(u) else 0.0)
    return {
        "dt": float(t[EVERY]) if len(t) > EVERY else 0.01,
        "theta1": np.round(x[picked, 0], 4).tolist(),
        "theta2": np.round(x[picked, 1], 4).tolist(),
        "joints": np.round(judged.points[picked].reshape(-1, 4), 4).tolist(),
        "torque": np.round(torque[picked], 3).tolist(),
        "up": judged.up,
        "held": np.round(judged.held, 3).tolist(),
    }


def frame(points, trail, reach: float, height: float, time: float) -> Image.Image:
    """One picture, drawn twice as large and scaled down, which smooths its edges.

    Args:
        points: (2, 2) m, elbow and end effector, x and y.
        trail: (n, 2) m, where the end effector has been; may be empty.
        reach: m, what the end effector reaches when it is stretched.
        height: of the line, as a fraction of it.
        time: s.
    """
    big = 2 * SIZE
    image = Image.new("RGB", (big, big), PALETTE["paper"])
    draw = ImageDraw.Draw(image)

    def place(p) -> tuple[float, float]:
        unit = 0.44 * big / reach
        return big / 2 + unit * p[0], big / 2 - unit * p[1]

    colour = PALETTE["three" if points[1, 1] > height * reach else "muted"]
    _, y = place((0, height * reach))
    dash = big / 60
    for start in np.arange(0, big, 2 * dash):
        draw.line([(start, y), (start + dash, y)], fill=colour, width=big // 240)
    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    font = ImageFont.truetype(str(path), big // 24)
    draw.text((big * 0.02, y + big * 0.012), f"{height:g} line", fill=colour, font=font)
    corner = big * 0.98, big * 0.95
    draw.text(corner, f"{time:.2f} s", fill=PALETTE["ink"], font=font, anchor="rs")
    if len(trail) > 1:
        draw.line([place(p) for p in trail], fill="#c5cad1", width=big // 120, joint="curve")
    joints = [place((0, 0)), place(points[0]), place(points[1])]
    for number, name in enumerate(("one", "two")):
        draw.line(joints[number : number + 2], fill=PALETTE[name], width=big // 36)
    for (cx, cy), r in zip(joints, (big / 45, big / 50, big / 60), strict=True):
        draw.ellipse([cx - r, cy - r, cx + r, cy + r], fill=PALETTE["ink"])
    return image.resize((SIZE, SIZE), Image.Resampling.LANCZOS)


def gif(path: Path, judged: Judged) -> None:
    """Write the swing-up of a run (its ``window``) as a GIF that repeats, atomically."""
    t, points, height = judged.t, judged.points, judged.task.height
    step = t[1] - t[0] if len(t) > 1 else 1 / RATE
    picked = np.round(np.arange(0, judged.window, 1 / RATE) / step).astype(int)
    back = round(TRAIL / step)
    images = [
        frame(points[k], points[max(k - back, 0) : k + 1 : 5, 1], judged.reach, height, t[k])
        for k in picked[picked < len(t)]
    ]
    # One palette of all the colours there are, from pictures with and without each of them.
    some = [np.asarray(images[k]) for k in (0, len(images) // 2, -1)]
    palette = Image.fromarray(np.concatenate(some)).quantize(64)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    # The last picture stays for a second, so that an eye can tell where the film begins.
    durations = [1000 // RATE] * (len(frames) - 1) + [1000]
    options = {"save_all": True, "append_images": frames[1:], "duration": durations, "loop": 0}
    buffer = io.BytesIO()
    frames[0].save(buffer, "GIF", **options)
    write_atomically(path, buffer.getvalue())

"""The pendulum in motion: numbers for the page that plays it, and a GIF."""

import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..files import write_atomically
from .figures import PALETTE

__all__ = ["gif", "keyframes"]

EVERY = 5  # of the 500 Hz samples the page plays one in five


def keyframes(t, x, u, points, joint: int, up: float | None) -> dict[str, Any]:
    """What the page needs to play a run, thinned out and rounded.

    Args:
        t: (n,) s, of at least one sample.
        x: (n, 4) rad, rad/s.
        u: (n - 1, 2) N m.
        points: (n, 2, 2) m, elbow and end effector, x and y, as ``plant.forward_kinematics``.
        joint: the driven one.
        up: s, the swing-up time; None without success.
    """
    picked = np.arange(0, len(t), EVERY)
    torque = np.append(u[:, joint], u[-1:, joint] if len(u) else 0.0)
    return {
        "dt": float(t[EVERY]) if len(t) > EVERY else 0.01,
        "theta1": np.round(x[picked, 0], 4).tolist(),
        "theta2": np.round(x[picked, 1], 4).tolist(),
        "joints": np.round(points[picked].reshape(-1, 4), 4).tolist(),
        "torque": np.round(torque[picked], 3).tolist(),
        "up": up,
    }


def _dashed(draw, y: float, width: float, colour: str, dash: float, line: int) -> None:
    for start in np.arange(0, width, 2 * dash):
        draw.line([(start, y), (start + dash, y)], fill=colour, width=line)


def _frame(points, trail, reach: float, height: float, time: float, size: int) -> Image.Image:
    """One picture, drawn twice as large and scaled down, which smooths its edges."""
    big = 2 * size
    image = Image.new("RGB", (big, big), PALETTE["paper"])
    draw = ImageDraw.Draw(image)

    def place(p) -> tuple[float, float]:
        unit = 0.44 * big / reach
        return big / 2 + unit * p[0], big / 2 - unit * p[1]

    line = PALETTE["three" if points[1, 1] > height * reach else "muted"]
    _, y = place((0, height * reach))
    _dashed(draw, y, big, line, big / 60, max(big // 240, 1))
    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    font = ImageFont.truetype(str(path), big // 24)
    draw.text((big * 0.02, y + big * 0.012), f"{height:g} line", fill=line, font=font)
    draw.text(
        (big * 0.98, big * 0.95), f"{time:.2f} s", fill=PALETTE["ink"], font=font, anchor="rs"
    )
    if len(trail) > 1:
        draw.line([place(p) for p in trail], fill="#c5cad1", width=big // 120, joint="curve")
    joints = [place((0, 0)), place(points[0]), place(points[1])]
    for number, colour in enumerate(("one", "two")):
        draw.line(joints[number : number + 2], fill=PALETTE[colour], width=big // 36)
    for (cx, cy), r in zip(joints, (big / 45, big / 50, big / 60), strict=True):
        draw.ellipse([cx - r, cy - r, cx + r, cy + r], fill=PALETTE["ink"])
    return image.resize((size, size), Image.Resampling.LANCZOS)


def gif(
    path: Path, t, points, reach: float, height: float, *, end: float, size: int = 320,
    rate: int = 25,
) -> None:  # fmt: skip
    """Write the run up to ``end`` s as a GIF that repeats, atomically.

    Args:
        path: of the file.
        t: (n,) s, evenly spaced.
        points: (n, 2, 2) m, elbow and end effector, x and y, as ``plant.forward_kinematics``.
        reach: m, what the end effector reaches when it is stretched.
        height: the line that it has to cross, as a fraction of ``reach``.
        end: s.
        size: pixels on a side.
        rate: frames per second.
    """
    step = t[1] - t[0] if len(t) > 1 else 1 / rate
    picked = np.round(np.arange(0, end, 1 / rate) / step).astype(int)
    back = round(0.6 / step)
    images = [
        _frame(points[k], points[max(k - back, 0) : k + 1 : 5, 1], reach, height, t[k], size)
        for k in picked[picked < len(t)]
    ]
    # One palette of all the colours there are, from pictures with and without each of them.
    some = [np.asarray(images[k]) for k in (0, len(images) // 2, -1)]
    palette = Image.fromarray(np.concatenate(some)).quantize(64)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    # The last picture stays for a second, so that an eye can tell where the film begins.
    durations = [1000 // rate] * (len(frames) - 1) + [1000]
    buffer = io.BytesIO()
    frames[0].save(
        buffer, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0
    )
    write_atomically(path, buffer.getvalue())

"""Performance against robustness: every measured controller, every seed, and the published boards.

    python experiments/front.py

reads leaderboard.json, seeds.json, ablation.json and plain.json beside this file and draws
front.png: a controller on the line is beaten in both by no other that was measured.
"""

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from jaxpend import cli, designs
from jaxpend.boards import PUBLISHED

HERE = Path(__file__).parent
# Okabe and Ito's palette: told apart by the colour-blind too.
STYLE = {
    "published": ("#000000", "D", "published boards"),
    "baseline": ("#0072B2", "o", "classical controllers, here"),
    "ablation": ("#E69F00", "s", "recipe with a part left out"),
    "shipped": ("#D55E00", "*", "recipe, every seed"),
}


def points(robot: str) -> list[tuple[str, str, float, float]]:
    """(kind, label, performance, robustness) of all there is."""
    found = [("published", name, *pair) for name, pair in PUBLISHED[robot].items()]
    rows = json.loads((HERE / "leaderboard.json").read_text())[robot]["rows"]
    for row in rows:
        if row["source"] == "measured" and row["robustness"] is not None and row["score"] > 0:
            found.append(("baseline", row["title"], row["score"], row["robustness"]))
    for name in ("seeds", "ablation", "plain"):
        for row in json.loads((HERE / f"{name}.json").read_text()):
            if row["robot"] == robot:
                kind = "shipped" if row["recipe"] == "shipped" else "ablation"
                label = "" if kind == "shipped" else row["recipe"]
                found.append((kind, label, row["snes"]["score"], row["robustness"]["median"]))
    return found


def front(scores: np.ndarray) -> np.ndarray:
    """Indices of the (n, 2) scores that no other beats in both, by rising performance."""
    beaten = (scores[None] >= scores[:, None]).all(-1) & (scores[None] > scores[:, None]).any(-1)
    best = np.flatnonzero(~beaten.any(1))
    return best[np.argsort(scores[best, 0])]


def main(out: Path = HERE / "front.png") -> None:
    """Draw the front of both robots."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.6), sharey=True, layout="constrained")
    for axis, robot in zip(axes, designs.ROBOTS, strict=True):
        found = points(robot)
        for kind, (colour, marker, title) in STYLE.items():
            mine = [p for p in found if p[0] == kind]
            size = 130 if marker == "*" else 36
            axis.scatter(
                [p[2] for p in mine], [p[3] for p in mine], s=size, c=colour, marker=marker,
                label=title, zorder=3, edgecolors="white", linewidths=0.6,
            )  # fmt: skip
            for _, label, x, y in mine:
                if kind == "published" or (kind == "baseline" and y > 0.7):
                    axis.annotate(
                        label, (x, y), (-5, 4), textcoords="offset points", fontsize=7,
                        ha="right", color=colour,
                    )  # fmt: skip
        scores = np.array([p[2:] for p in found if p[0] != "published"])
        best = scores[front(scores)]
        axis.plot(*best.T, color="0.6", lw=1.2, zorder=2)
        axis.set(title=robot, xlabel="performance score (v2)", xlim=(0.18, 0.74), ylim=(0, 1.03))
        axis.grid(color="0.92")
        axis.set_axisbelow(True)
    axes[0].set_ylabel("robustness score (v2)")
    axes[0].legend(loc="lower left", fontsize=8, frameon=False)
    figure.savefig(out, dpi=150)


if __name__ == "__main__":
    cli.run(main, "experiments/front.py")

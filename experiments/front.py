"""Performance against robustness: every measured controller, every seed, and the published boards.

    python experiments/front.py

reads leaderboard.json, seeds.json, demonstrated.json, ablation.json and plain.json beside this
file and draws front.png: a controller on the line is beaten in both by no other that was measured.
"""

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxpend import cli
from jaxpend.boards import V2, v2

HERE = Path(__file__).parent
# Okabe and Ito's palette: told apart by the colour-blind too.
STYLE = {
    "published": ("#000000", "D", "published boards"),
    "baseline": ("#0072B2", "o", "classical controllers, here"),
    "ablation": ("#E69F00", "s", "imitation with a part left out or added"),
    "plain": ("#CC79A7", "^", "the paper's SAC and SNES, every seed"),
    "demonstrated": ("#009E73", "P", "imitation, every seed"),
    "learned": ("#D55E00", "*", "make train, every seed"),
}


def points(robot: str) -> list[tuple[str, str, float, float]]:
    """(kind, label, performance, robustness) of all there is."""
    found: list[tuple[str, str, float, float]] = [("published", *r) for r in v2(robot).published]
    rows = json.loads((HERE / "leaderboard.json").read_text())[robot]["rows"]
    for row in rows:
        ours = row["source"] == "measured" and not row["name"].startswith("policy")
        if ours and row["robustness"] is not None and row["score"] > 0:
            found.append(("baseline", row["title"], row["score"], row["robustness"]))
    for name in ("seeds", "demonstrated", "ablation", "plain"):
        for row in json.loads((HERE / f"{name}.json").read_text()):
            if row["robot"] == robot:
                kind = row["recipe"] if row["recipe"] in STYLE else "ablation"
                label = row["recipe"] if kind == "ablation" else ""
                found.append((kind, label, row["snes"]["score"], row["robustness"]["median"]))
    return found


def front(scores: np.ndarray) -> np.ndarray:
    """Indices of the (n, 2) scores that no other beats in both, by rising performance."""
    beaten = (scores[None] >= scores[:, None]).all(-1) & (scores[None] > scores[:, None]).any(-1)
    best = np.flatnonzero(~beaten.any(1))
    return best[np.argsort(scores[best, 0])]


def draw(axis, found: list[tuple], labelled: str) -> None:
    """Points of every kind, names at those of one kind, and the front of what was measured."""
    for kind, (colour, marker, title) in STYLE.items():
        mine = [p for p in found if p[0] == kind]
        axis.scatter(
            [p[2] for p in mine], [p[3] for p in mine], s=130 if marker == "*" else 36, c=colour,
            marker=marker, label=title, zorder=3, alpha=0.85, edgecolors="white", linewidths=0.6,
        )  # fmt: skip
        named = sorted(mine, key=lambda p: -p[3]) if kind == labelled else []
        for i, (_, label, x, y) in enumerate(named):
            # Right of a point; below or above it where other points or labels are in the way.
            crowded = any(abs(x - p[2]) < 0.1 and p[3] - y < 0.04 for p in named[:i])
            place, side = (8, 2), "left"
            if kind == "published" and (crowded or x > 0.45):
                place, side = (0, -15 if crowded else 8), "center"
            axis.annotate(
                label, (x, y), place, textcoords="offset points", fontsize=8, ha=side,
                color=colour, annotation_clip=True, zorder=2.5,
                bbox={"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 0.5},
            )  # fmt: skip
    scores = np.array([p[2:] for p in found if p[0] != "published"])
    label = "beaten in both by nothing that was measured"
    # A staircase: below it and to its left, something that was measured is at least as good.
    edge = np.concatenate([[[0, 0]], scores[front(scores)], [[0, 0]]])
    edge[0], edge[-1] = (0, edge[1, 1]), (edge[-2, 0], 0)
    axis.step(*edge.T, where="pre", color="0.6", lw=1.2, zorder=1, label=label)
    axis.grid(color="0.92")
    axis.set_axisbelow(True)


def main(out: Path = HERE / "front.png") -> None:
    """Draw the front of both robots, whole and its upper right corner."""
    figure = Figure(figsize=(10, 9), layout="constrained")
    axes = figure.subplots(2, 2)
    corners = {"acrobot": (0.64, 0.735), "pendubot": (0.69, 0.705)}
    for column, robot in enumerate(V2):
        whole, corner = axes[:, column]
        found = points(robot)
        draw(whole, found, "published")
        draw(corner, found, "baseline")
        whole.set(title=robot, xlim=(0.18, 0.74), ylim=(-0.02, 1.03))
        corner.set(xlim=corners[robot], ylim=(0.55, 1.0), title="upper right corner")
        for axis in (whole, corner):
            axis.set_xlabel("performance score (v2)")
    for row in axes:
        row[0].set_ylabel("robustness score (v2)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    cli.run(main, "experiments/front.py")

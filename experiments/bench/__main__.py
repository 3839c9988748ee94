"""All parts of the benchmark, each in a process of its own: ``python experiments/bench``.

It prints what each part prints, and writes bench.json, bench.md and bench.png beside this folder.
``--parts steps updates`` runs these alone, and keeps what bench.json has of the others.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from jaxpend.files import write_atomically

HERE = Path(__file__).parent
PARTS = ("steps", "generation", "robustness", "updates", "shared", "mpc", "growth", "learning")
CURVES = {
    "number of rollouts": "rollouts in one vmap", "width": "width of both hidden layers",
    "horizon, s": "horizon, s", "seeds of SAC": "seeds of SAC in one vmap",
}  # fmt: skip


def table(found: dict) -> str:
    """All rows as Markdown."""
    lines = ["| part | | speed | of the first | processor (lowest to highest) | wall | compiled |"]
    lines.append("|---|---|---|---|---|---|---|")
    for name in PARTS:
        first = {}
        for row in found.get(name, {"rows": []})["rows"]:
            ratio = row["speed"] / first.setdefault(row["part"], row["speed"])
            seconds = f"{row['processor']:.4f} s ({row['low']:.4f} to {row['high']:.4f})"
            cells = [row["part"], row["way"], f"{row['speed']:.3g} {row['unit']}/s", f"{ratio:.2f}"]
            compiled = "in it" if row["compile"] is None else f"{row['compile']:.1f} s"
            cells += [seconds, f"{row['wall']:.4f} s", compiled]
            lines.append(f"| {' | '.join(cells)} |")
    machines = {name: part["machine"] for name, part in found.items()}
    for name, about in machines.items():
        versions = ", ".join(f"{key} {value}" for key, value in about["versions"].items())
        where = f"{about['processor']}, {about['cores']} core(s), {about['device']}"
        peak = f"{about['matrix_gflops']:.0f} GFLOP/s in large matrix products"
        lines.append(f"\n`{name}`: {where}, {peak}; {versions}; {about['date']}.")
    return "\n".join(lines) + "\n"


def picture(found: dict, path: Path) -> None:
    """Growth, and how near the networks come to the rate of large matrix products."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    figure, axes = plt.subplots(1, 5, figsize=(17, 3.4), layout="constrained")
    rows = found["growth"]["rows"]
    for axis, (part, label) in zip(axes, CURVES.items(), strict=False):
        chosen = [row for row in rows if row["part"] == part]
        x = [float(row["way"]) for row in chosen]
        axis.semilogx(x, [row["speed"] for row in chosen], "o-")
        axis.set(xlabel=label, ylabel=f"{chosen[0]['unit']} a processor second")
    chosen = [row for row in rows if row["part"] == "width"]
    widths = np.array([float(row["way"]) for row in chosen])
    flop = 2 * (6 * widths + widths**2 + widths)
    axes[-1].semilogx(widths, flop * [row["speed"] / 1e9 for row in chosen], "o-", label="networks")
    peak = found["growth"]["machine"]["matrix_gflops"]
    axes[-1].axhline(peak, color="gray", linestyle="--", label="large matrix products")
    axes[-1].set(xlabel=CURVES["width"], ylabel="GFLOP/s")
    axes[-1].legend()
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.set_ylim(bottom=0)
        axis.xaxis.set_minor_formatter(NullFormatter())
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run the parts, and keep what they say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS)
    kept = HERE.parent / "bench.json"
    found = json.loads(kept.read_text()) if kept.exists() else {}
    for name in parser.parse_args().parts:
        print(f"--- {name}", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "rows.json"
            done = subprocess.run([sys.executable, HERE / f"{name}.py", "--json", file])
            if done.returncode:
                sys.exit(f"{name} failed; the others are in {kept}")
            found[name] = json.loads(file.read_text())
        write_atomically(kept, json.dumps(found, indent=1) + "\n")
    write_atomically(kept.with_suffix(".md"), table(found))
    if "growth" in found:
        picture(found, kept.with_suffix(".png"))


if __name__ == "__main__":
    main()

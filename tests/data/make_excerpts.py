"""Cut the excerpts in this folder out of the golden files of the reference simulator.

Usage: ``python tests/data/make_excerpts.py GOLDEN_FOLDER``. Only numbers are carried over, at
full float64 precision; what is thinned out is time (closed loops keep every n-th sample, and
an error anywhere shows in all that follow) and, for the synthetic trajectories, the cases.
"""

import json
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
ROBOTS = ("acrobot", "pendubot")
# The closed loops of the trajectory file that rounding does not tear apart within 10 s.
STABLE = ("free_swing", "const_torque", "pd", "pd_friction", "pd_euler", "lqr_top")


def thin(golden, names, every):
    """The arrays ``names`` of an npz file, every n-th sample of their time axis (the second)."""
    return {name: golden[name][:, ::every] for name in names}


def constants(golden, names):
    """The arrays ``names`` as they are."""
    return {name: golden[name] for name in names}


def dynamics(golden):
    """The 20 rows on model 1.0 and 60 random ones."""
    rows = np.r_[0:20, 20:500:8]
    return {k: golden[k][rows] if golden[k].ndim else golden[k] for k in golden}


def trajectories(golden):
    """Single steps of every case, whole loops of the stable ones (thinned), one whole swing-up."""
    k = np.r_[0:5, 7:5000:139]
    x, u = golden["X"], golden["U"]
    kept = {"step_x": x[:, k], "step_u": u[:, k], "step_x_next": x[:, k + 1]}
    kept |= {f"step_{name}": golden[name] for name in ("integrator", "params", "B")}
    stable = np.isin(golden["names"], STABLE)
    judged = [n for n in golden if n.startswith(("metric_", "score_"))]
    for name in ("names", "integrator", "params", "B", "x0", *judged):
        kept[f"loop_{name}"] = golden[name][stable]
    kept["loop_X"], kept["lqr_K"] = x[stable][:, ::100], golden["lqr_K"]
    swing = list(golden["names"]).index("evolsac")
    kept |= {"swing_T": golden["T"], "swing_X": x[swing], "swing_U": u[swing]}
    return kept | {f"swing_{name}": golden[name][swing] for name in judged}


def imperfections(golden):
    """All 24 closed loops, every 25th sample; the rest of each array is its constants."""
    loops = thin(golden, ["X", "U", "U_command", "X_meas"], 25)
    series = {"T", "perturbation_array", "perturbation_index", *loops}
    return loops | constants(golden, [name for name in golden if name not in series])


def noise(golden):
    """All four closed loops, thinned; the draws come back from their seeds."""
    loops = thin(golden, ["X", "U", "U_command", "X_meas"], 25)
    return loops | constants(golden, [n for n in golden if n not in {"T", "z", *loops}])


def perturbation(golden):
    """The 10 s run, every 25th step: where the index drift acts, neighbours do not matter."""
    kept = {name: golden[name] for name in golden if name != "T"}
    kept["perturbation_array"] = kept["perturbation_array"][:, ::25]
    for name in ("X", "U", "U_command"):
        for actuation in ("selectiveB", "fullB"):
            kept[f"{name}_{actuation}"] = kept[f"{name}_{actuation}"][::25]
    return kept | {"perturbation_index": kept["perturbation_index"].astype("i2")}


def metrics(golden):
    """One synthetic trajectory of each kind, cut to its length and put end to end."""
    cases = [int(np.flatnonzero(golden["kind"] == kind)[0]) for kind in np.unique(golden["kind"])]
    length = golden["length"][cases]
    series = {
        name: np.concatenate([golden[name][i, :n] for i, n in zip(cases, length, strict=True)])
        for name in ("T", "X", "U")
    }
    names = [n for n in golden if golden[n].shape == (200,)]
    return series | {name: golden[name][cases] for name in names}


def thrown(golden):
    """Laws that rounding does not tear apart in 60 s: every 25th kept step, the judgement."""
    laws = np.isin(golden["names"], ("pd", "full_pd"))
    kept = constants(golden, ["seeds", "targets", "reset_first", "reset_steps"])
    kept["names"] = golden["names"][laws]
    for name in ("uptime", "score", "number_of_swingups", "X_end"):
        kept[name] = golden[name][laws]
    for seed in golden["seeds"]:
        kept[f"k_{seed}"] = golden[f"k_{seed}"][::25]
        for name in ("X", "U", "U_command"):
            kept[f"{name}_{seed}"] = golden[f"{name}_{seed}"][laws][:, ::25]
    return kept


def robustness(golden):
    """The grids and counts of the robustness benchmark, all of them."""
    grids = golden["model_parameter_grids"] | {
        "velocity_noise": golden["velocity_noise"]["sigma_velocity_grid"],
        "torque_noise": golden["torque_noise"]["sigma_grid"],
        "responsiveness": golden["torque_responsiveness_grid"],
        "delay": golden["delay"]["grid"],
    }
    return {"grids": grids, "n_simulations": golden["n_simulations"]}


def main(folder: Path) -> None:
    """Write every excerpt."""
    grids = robustness(json.loads((folder / "robustness_grid.json").read_text()))
    (HERE / "robustness_grid.json").write_text(json.dumps(grids, indent=1) + "\n")
    cuts = {"dynamics": dynamics, "metrics_random": metrics}
    for robot in ROBOTS:
        cuts[f"trajectories_{robot}"] = trajectories
        cuts[f"imperfections_{robot}"] = imperfections
        cuts[f"noise_{robot}"] = noise
        cuts[f"perturbation10s_{robot}"] = perturbation
        cuts[f"global_{robot}"] = thrown
    for name, cut in cuts.items():
        with np.load(folder / f"{name}.npz") as golden:
            np.savez_compressed(HERE / f"{name}.npz", **cut(dict(golden)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

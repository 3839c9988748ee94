"""The shipped policies as submissions, run by the RealAIGym package itself, beside ours.

    python experiments/reference_check.py DOUBLE_PENDULUM [--robots acrobot pendubot] [--runs 60]
    python experiments/reference_check.py DOUBLE_PENDULUM --recordings

DOUBLE_PENDULUM is a checkout of github.com/dfki-ric-underactuated-lab/double_pendulum, of which
nothing is changed; its plant needs sympy and pandas (``pip install sympy pandas``). Each robot's
policy is exported (``interop.realaigym``), and its numpy controller is judged there: the score of
the performance board, and runs of the robustness board, with the same draws of noise and the same
pulses on both sides. Says how far the scores are apart, and how many flags of success are equal.
``--recordings``: the scores of the runs of robots that the checkout holds, there and here.
"""

import argparse
import contextlib
import csv
import dataclasses
import importlib.util
import io
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

from jaxpend.boards import Board, Strip, hardware, v2
from jaxpend.controllers.files import load_policy
from jaxpend.interop import realaigym
from jaxpend.interop.csv import load_csv
from jaxpend.rollout import rollout
from jaxpend.scenario import NEUTRAL, Pulses, Scenario, with_neutral
from jaxpend.score import official, recorded
from jaxpend.sweep import upright
from jaxpend.variations import vary

# Which of the 21 values of each grid: of ten model parameters and of five other criteria. Of the
# perturbations, which seeds.
MODEL = (3, 13, 18)
OTHERS = {
    "velocity_noise": (4, 8, 12, 14, 17, 20), "torque_noise": (4, 8, 12, 14, 17, 20),
    "responsiveness": (0, 2, 5, 10, 15, 20), "delay": (2, 5, 10, 14, 17, 20),
    "perturbation": (0, 1, 2, 3, 4, 5),
}  # fmt: skip
GRID = {"per_joint": 3, "distance": 1.0, "width": [0.05, 0.1], "amplitude": [0.5, 5.0]}


@dataclasses.dataclass(frozen=True)
class Run:
    """One run of the robustness benchmark; its number is the seed of what it draws."""

    criterion: str
    variation: str
    value: float
    seed: int


def chosen(strips: list[Strip], most: int) -> list[Run]:
    """At most so many runs, spread over all criteria."""
    runs = []
    for strip in strips:
        for index in OTHERS.get(strip.variation, MODEL):
            value = float(strip.values[index])
            runs.append(Run(strip.criterion, strip.variation, value, len(runs)))
    return runs[:: max(1, -(-len(runs) // most))]


def here(board: Board, policy, runs: list[Run], pulses: dict[int, Pulses]) -> np.ndarray:
    """Flags of success of our rollout, in float64."""
    plant, steps = board.task.plant, board.task.steps
    base = with_neutral(Scenario(plant), {*NEUTRAL, "coulomb_friction"})
    scenarios, normals = [], np.zeros((len(runs), steps, 10))
    for row, run in enumerate(runs):
        one = vary(base, {run.variation: [run.value]}, key=jax.random.key(0), dt=board.task.dt)
        if run.variation == "perturbation":
            one = one.replace(pulses=jax.tree.map(lambda a: a[None], pulses[run.seed]))
        if run.variation.endswith("noise"):
            normals[row] = np.random.RandomState(run.seed).standard_normal((steps, 10))
        scenarios.append(one)
    batch = jax.tree.map(lambda *parts: np.concatenate(parts), *scenarios)

    def end(scenario, normals):
        return rollout(scenario, policy, jax.random.key(0), normals=normals).x[-1]

    return np.asarray(upright(jax.jit(jax.vmap(end))(batch, normals)))


def there_once(benchmark, run: Run) -> bool:
    """The flag of success of one run of the reference's benchmark."""
    np.random.seed(run.seed)  # noqa: NPY002
    if run.criterion == "model":
        found = benchmark.check_modelpar_robustness([run.variation], {run.variation: [run.value]})
        return bool(found[run.variation]["successes"][0])
    if run.variation == "velocity_noise":
        found = benchmark.check_meas_noise_robustness(1, "vel", [run.value])["None"]
    elif run.variation == "torque_noise":
        found = benchmark.check_unoise_robustness(1, [run.value])
    elif run.variation == "responsiveness":
        found = benchmark.check_uresponsiveness_robustness([run.value])
    elif run.variation == "delay":
        found = benchmark.check_delay_robustness("posvel", [run.value])
    else:
        options = GRID["per_joint"], GRID["distance"], GRID["width"], GRID["amplitude"]
        found = benchmark.check_perturbation_robustness(1, *options)
    return bool(np.ravel(found["successes"])[0])


def pulses_of(seed: int) -> Pulses:
    """The pulses that the reference draws after ``np.random.seed(seed)``."""
    from double_pendulum.simulation import perturbations

    np.random.seed(seed)  # noqa: NPY002
    options = GRID["per_joint"], GRID["distance"], GRID["width"], GRID["amplitude"]
    _, *drawn = perturbations.get_random_gauss_perturbation_array(10.0, 0.002, *options)
    return Pulses(*(np.asarray(part) for part in drawn))


def score_there(controller, about, folder: Path) -> float:
    """The score of the performance board: its plant, simulator, file and formula."""
    from double_pendulum.analysis.leaderboard import leaderboard_scores
    from double_pendulum.model.symbolic_plant import SymbolicDoublePendulum
    from double_pendulum.simulation.simulation import Simulator
    from double_pendulum.utils.csv_trajectory import save_trajectory

    simulator = Simulator(plant=SymbolicDoublePendulum(model_pars=about.mpar))
    times = {"t0": about.t0, "x0": about.x0, "tf": about.t_final, "dt": about.dt}
    t, x, u = simulator.simulate(**times, controller=controller, integrator=about.integrator)
    save_trajectory(folder / "sim_swingup.csv", T=t, X_meas=x, U_con=u)
    norms = dict(v2("acrobot").task.scoring.norms)
    entry = {"csv_path": str(folder / "sim_swingup.csv"), "name": "ours", "username": "ours"}
    leaderboard_scores(
        {"ours": entry | {"short_description": "ours"}}, folder / "entry.csv", about.mpar,
        weights=dict.fromkeys(norms, 1.0) | {"max_tau": 0.0, "integ_tau": 0.0}, normalize=norms,
        score_version="v2",
    )  # fmt: skip
    with (folder / "scores_v2.csv").open() as file:  # the entry itself has three decimals
        return float(next(csv.DictReader(file))["RealAI Score"])


def benchmark_there(controller, about):
    """The reference's benchmark, as its script makes it."""
    from double_pendulum.analysis.benchmark import benchmarker

    made = benchmarker(
        controller=controller, x0=about.x0, dt=about.dt, t_final=about.t_final, goal=about.goal,
        epsilon=[0.35, 0.35, 1.0, 1.0], check_only_final_state=True, integrator=about.integrator,
    )  # fmt: skip
    made.set_model_parameter(model_pars=about.mpar)
    return made


def exported(robot: str, board: Board, checkout: Path, folder: Path):
    """The controller of a submission as the reference imports it, and the board's parameters."""
    import double_pendulum.controller as package

    where = folder / f"jaxpend_{robot}"
    realaigym.write(lambda plant: load_policy(robot), board, where, robustness=False)
    package.__path__.append(str(where / "src/python/double_pendulum/controller"))
    sys.path.insert(0, str(where / f"leaderboard/{robot}/simulation_v2"))
    controller = importlib.import_module(f"con_jaxpend_{robot}").controller
    place = checkout / f"leaderboard/{robot}/simulation_v2"
    specification = importlib.util.spec_from_file_location(robot, place / "sim_parameters.py")
    about = importlib.util.module_from_spec(specification)
    with contextlib.chdir(place):  # it names a file relative to its folder
        specification.loader.exec_module(about)
    return controller, about


def compare(robot: str, checkout: Path, most: int, folder: Path) -> tuple[int, int]:
    """Print both sides of a robot; how many runs there are, and on how many the flags agree."""
    board = v2(robot)
    controller, about = exported(robot, board, checkout, folder)
    with contextlib.redirect_stdout(io.StringIO()):
        theirs = score_there(controller, about, folder)
    ours = official(load_policy(robot), board)["score"]
    apart = f"apart {abs(ours - theirs):.1e}"
    print(f"{robot}: score there {theirs:.10f}, here {ours:.10f}, {apart}", flush=True)
    with jax.enable_x64(True):
        runs = chosen(board.trials(board.task.plant), most)
        pulses = {run.seed: pulses_of(run.seed) for run in runs if run.variation == "perturbation"}
        flags = here(board, load_policy(robot), runs, pulses)
    benchmark, start, equal = benchmark_there(controller, about), time.perf_counter(), 0
    by_criterion: dict[str, list[tuple[bool, bool]]] = {}
    for run, ours_up in zip(runs, flags, strict=True):
        with contextlib.redirect_stdout(io.StringIO()):
            up = there_once(benchmark, run)
        equal += int(up == ours_up)
        by_criterion.setdefault(run.criterion, []).append((up, bool(ours_up)))
        if up != ours_up:
            print(f"  {run}: success there {up}, here {ours_up}")
    for criterion, pairs in by_criterion.items():
        there, here_ = (sum(side) for side in zip(*pairs, strict=True))
        print(f"  {criterion:15} {len(pairs):3} runs, success there {there:3}, here {here_:3}")
    seconds = time.perf_counter() - start
    print(f"  equal flags on {equal} of {len(runs)} runs ({seconds:.0f} s there)", flush=True)
    return len(runs), equal


def recordings(checkout: Path, folder: Path) -> None:
    """The scores of the runs that the hardware boards keep, there and here."""
    from double_pendulum.analysis.leaderboard import leaderboard_scores
    from double_pendulum.model.model_parameters import model_parameters

    # Of the plant only the lengths of its links count here.
    at = "data/system_identification/identified_parameters/design_C.1/model_1.0"
    about = model_parameters(filepath=str(checkout / at / "model_parameters.yml"))
    apart = []
    for path in sorted(checkout.glob("leaderboard/*/real_hardware*_v2/**/trajectory.csv")):
        board = hardware(path.relative_to(checkout).parts[1])
        shutil.copy(path, folder / "trajectory.csv")  # the reference writes beside it
        entry = {"csv_path": str(folder / "trajectory.csv"), "name": "", "username": ""}
        norms = dict(board.task.scoring.norms)
        weights = dict.fromkeys(norms, 1.0) | {"max_tau": 0.0, "integ_tau": 0.0}
        leaderboard_scores(
            {"": entry | {"short_description": ""}}, folder / "entry.csv", about,
            weights=weights, normalize=norms, simulation=False, score_version="v2",
        )  # fmt: skip
        with (folder / "scores_v2.csv").open() as file:
            theirs = float(next(csv.DictReader(file))["RealAI Score"])
        apart.append(abs(recorded(load_csv(path), board, regular=False)["score"] - theirs))
    print(f"{len(apart)} recordings of robots: scores at most {max(apart):.1e} apart", flush=True)


def main() -> None:
    """Compare the robots; exits with 1 if a flag differs."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("checkout", type=Path)
    parser.add_argument("--robots", nargs="+", default=["acrobot", "pendubot"])
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--recordings", action="store_true", help="those of robots instead")
    args = parser.parse_args()
    sys.path.insert(0, str(args.checkout / "src" / "python"))
    os.environ.setdefault("MPLBACKEND", "agg")
    with tempfile.TemporaryDirectory() as folder:
        if args.recordings:
            recordings(args.checkout, Path(folder))
            return
        done = [compare(robot, args.checkout, args.runs, Path(folder)) for robot in args.robots]
    total, equal = (sum(numbers) for numbers in zip(*done, strict=True))
    print(f"together: equal flags on {equal} of {total} runs")
    sys.exit(int(equal < total))


if __name__ == "__main__":
    main()

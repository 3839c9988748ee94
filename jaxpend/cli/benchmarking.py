"""The command ``jaxpend robustness``."""

from pathlib import Path
from typing import Literal

from ..fields import Count, Natural, Positive, Robot, Seed
from ..robots import ROBOTS
from .judging import Subject
from .output import check_json, check_results, emit_json

__all__ = ["robustness"]


def robustness(
    robot: Robot = "pendubot",
    policy: str | None = None,
    controller: str | None = None,
    plant: str | None = None,
    design: str | None = None,
    torque_limit: Positive = 6.0,
    seed: Seed = 0,
    keys: Count = 3,
    precision: Literal["float32", "float64"] = "float32",
    scored: bool = False,
    map: tuple[str, str] | None = None,
    worst: Natural = 0,
    chunk: Count | None = None,
    devices: Natural = 0,
    out: Path | None = Path("runs/robustness"),
    json: str | None = None,
) -> None:
    """The official six-criterion robustness benchmark of a controller.

    Args:
        robot: which joint is driven: the second of the acrobot, the first of the pendubot.
        policy: a policy or controller file; by default the policy that ships with the package.
        controller: judge this instead: a known one such as tvlqr, or module:name of a
            controller, or of one written for RealAIGym or a Python function (t, x) -> torque,
            which take minutes. With a policy too: the known one around that policy, or the file
            of your own classes.
        plant: YAML file of the parameters of another plant than that of the boards.
        design: or an identified plant by name, such as C.1/1.0.
        torque_limit: of the driven joint, N m; 6 on the boards.
        seed: of the first key.
        keys: repeat the criteria that draw something this often; the median counts.
        precision: float32, or float64 as the reference computes.
        scored: the mean v2 performance score at every grid value as well.
        map: success over two imperfections, such as "m2 delay", 21 x 21 runs.
        worst: look for the mildest combination of imperfections that fails, in so many tries.
        chunk: runs at a time; less needs less memory.
        devices: how many GPUs, or cores of a processor, share the runs; 0: all.
        out: folder for picture, CSV and JSON, of both robots once they are there; or None.
        json: write the result as JSON to this file, or "-" for standard output.
    """
    marked = {name: (f"{name}.json", b'"over_keys"') for name in ROBOTS}
    check_results(out, [f"{robot}.json", f"{robot}.csv", f"{robot}_map.png"], marked[robot])
    check_results(out, ["robustness.png"], *marked.values())
    pictures = (f"{robot}.csv", f"{robot}_map.png", "robustness.png")
    check_json(json, "over_keys", out, pictures)
    subject = Subject(robot, policy, controller, plant, design, torque_limit)
    import jax

    from ..devices import use

    use(devices)
    result = {"robot": robot, "controller": controller or policy or robot, "seed": seed}
    result |= {"plant": plant, "design": design, "precision": precision}
    board, result["torque_limit"] = subject.board, torque_limit
    with jax.enable_x64(precision == "float64"):
        judged, options = subject.find(board), {"scored": scored, "chunk": chunk}
        result |= _benchmarked(judged, board, seed, keys, map, worst, options)
    _show(result, board, out)
    emit_json(result, json)


def _show(result, board, out):
    """A table, and files in a folder."""
    from .tables import robustness_table

    robustness_table(result, board)
    if out is not None:
        from ..report.figures import write_robustness

        write_robustness(result, out)


def _benchmarked(judged, board, seed, keys, map, worst, options):
    """The report of the benchmark, and the map and the mildest failure that are asked for."""
    import jax

    from ..robustness import benchmark, nominal_and_worst, success_map
    from ..sweep import mildest_failure

    plant, key = board.task.plant, jax.random.key(seed)
    # The map comes first, since it refuses names that it does not know.
    drawn = {} if map is None else {"map": success_map(judged, plant, map, key, options)}
    result = benchmark(judged, plant, key, keys=keys, **options).as_dict() | drawn
    if worst:
        bounds = nominal_and_worst(plant)
        result["worst"] = mildest_failure(plant, judged, bounds, key, samples=worst)
    return result

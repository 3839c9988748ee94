"""The command ``jaxpend hardware``."""

import dataclasses
from pathlib import Path

from ..fields import Count, Natural, Preset, Robot, Seed
from .judging import Subject
from .output import check_json, check_results, emit_json

__all__ = ["hardware"]


def hardware(
    robot: Robot = "pendubot",
    policy: str | None = None,
    controller: str | None = None,
    preset: Preset = "identified",
    robots: Count = 1000,
    seed: Seed = 0,
    plant: str | None = None,
    design: str | None = None,
    devices: Natural = 0,
    out: Path | None = Path("runs/hardware"),
    json: str | None = None,
) -> None:
    """How often a controller stands on a fleet of real robots, without and with pushes.

    Args:
        robot: which joint is driven: the second of the acrobot, the first of the pendubot.
        policy: a policy or controller file; by default the hardware policy that ships.
        controller: judge this instead, as in jaxpend score.
        preset: how robots differ: identified, wide, compensated (passive friction, by a motor
            there), or as the authors trained.
        robots: how many are drawn; each is tried without and with pushes.
        seed: of the draws.
        plant: YAML file of the nominal parameters, by default those of design C.1 model 1.0.
        design: or an identified plant by name, such as C.1/1.1.
        devices: how many GPUs, or cores of a processor, share the robots; 0: all.
        out: folder for the picture and the JSON; or None.
        json: write the result as JSON to this file, or "-" for standard output.
    """
    name = f"{preset}_{robot}"
    check_results(out, [f"{name}.json", f"{name}.png"], (f"{name}.json", b'"by"'))
    check_json(json, "conditions", out, [f"{name}.png"])
    subject = Subject(robot, policy, controller, plant, design, on="hardware")
    import jax

    from ..devices import use
    from ..fleet import judge_fleet
    from ..hardware import PRESETS
    from ..terminal import console
    from .tables import hardware_table

    use(devices)
    board = subject.board
    task = dataclasses.replace(board.task, spread=PRESETS[preset])
    result = {"robot": robot, "preset": preset, "seed": seed} | subject.about
    judged = subject.find(board)
    with console.status("judging ...") as status:
        found = judge_fleet(
            judged, task, jax.random.key(seed), robots=robots,
            say=lambda done: status.update(f"{done} of {robots} robots"),
        )  # fmt: skip
    result |= found.as_dict()
    if json != "-":
        hardware_table(result, subject.name)
    if out is not None:
        from ..report.figures import write_hardware

        console.print(f"wrote {write_hardware(result, out)}", soft_wrap=True)
    emit_json(result, json)

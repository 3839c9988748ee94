"""The command ``jaxpend identify``."""

import shlex
from pathlib import Path

from ..errors import JaxpendError
from ..fields import Positive
from .output import check_apart, check_file, check_json, emit_json

__all__ = ["identify"]

BEGINS = b"# A plant identified from "


def identify(
    recordings: tuple[Path, ...],
    /,
    out: Path,
    plant: str | None = None,
    design: str | None = None,
    parameters: tuple[str, ...] | None = None,
    window: Positive = 0.25,
    json: str | None = None,
) -> None:
    """A plant file of a robot, fitted to recorded trajectories, which every command takes.

    Args:
        recordings: CSV files in the layout of RealAIGym, of one robot and one time step.
        out: plant file to write.
        plant: YAML file of the parameters where the search starts, and of those not fitted.
        design: or an identified plant by name, such as C.1/1.0, which is the default.
        parameters: which are fitted, by default r1 I1 r2 I2 b1 b2 cf1 cf2 Ir delay; lengths and
            masses are better measured.
        window: s, the pieces that are simulated at once.
        json: write the result as JSON to this file, or "-" for standard output.
    """
    if str(out) == "-":
        raise JaxpendError("--out is -; a plant file cannot go to standard output")
    if plant and design:
        raise JaxpendError("--plant and --design are both given; the search starts from one")
    check_file(out, (BEGINS,))
    check_json(json, "parameters")
    check_apart(json=json, out=out)
    from .. import designs
    from ..files import write_atomically
    from ..identification import FITTED
    from ..identification import identify as fit
    from ..interop.csv import load_csv
    from ..terminal import console
    from .tables import identified_table

    nominal = designs.read(plant) if plant else designs.parameters(design or "C.1/1.0")
    runs = [load_csv(path) for path in recordings]
    with console.status("identifying ..."):
        found = fit(runs, nominal, parameters or FITTED, window=window)
    if json != "-":
        identified_table(found, nominal)
    names = shlex.join(repr(str(path))[1:-1] for path in recordings)  # on one line
    lines = [f"{BEGINS.decode()}{names}", f"# delay of measurements: {found.delay:.5g} s"]
    for name, value in found.parameters.items():
        known = found.deviations.get(name)
        lines.append(f"{name}: {value!r}" + (f"  # +- {known:.2g}" if known else ""))
    write_atomically(out, "\n".join(lines) + "\n")
    console.print(f"wrote {out}; --plant {out} makes a command take it", soft_wrap=True)
    emit_json(found.as_dict(), json)

"""The command ``jaxpend export``."""

import re
from pathlib import Path
from typing import Literal

from ..errors import JaxpendError
from .output import check_file, check_folder

__all__ = ["export"]

# Near the start of every file that is written here, and of no other that names this package.
MARK = re.compile(rb"; jaxpend\.interop\.\w+ wrote it|; see jaxpend\.interop\.onnx\.")
START = 400  # bytes
PRECISIONS = {  # the first unless told
    "numpy": ("float64",), "realaigym": ("float64",), "onnx": ("float64", "float32"),
    "c": ("float32", "float64", "single"),
}  # fmt: skip


def export(
    policy: str,
    /,
    to: Literal["numpy", "onnx", "c", "realaigym"],
    out: Path,
    precision: Literal["float32", "float64", "single"] | None = None,
) -> None:
    """A policy or controller as a file for where there is no jax.

    It holds all that the controller does in a step: observation, memory, observer and rescue.
    A controller that loops, such as MPC, is refused.

    Args:
        policy: a policy or controller file, or the name of a policy that ships with the package,
            such as acrobot.
        to: numpy, a Python file with a class; onnx, a model with its memory as inputs and outputs;
            c, a header without allocation; realaigym, a submission to its boards in numpy, with
            what they measure, which takes a while.
        out: file to write; for realaigym a folder, whose name the submission has.
        precision: of c float32 unless told, which computes with pairs of floats, for torques within
            1e-5 N m of those here; float64, within 1e-9; single, one float for a number, the
            fastest: a guard's observer multiplies rounding, so that it is within 4e-3 there. Of
            onnx float64 unless told, or float32, as close as single. numpy has float64 alone.
    """
    chosen = precision or PRECISIONS[to][0]
    if chosen not in PRECISIONS[to]:
        text = f"--precision is {precision}; {to} computes in {' or '.join(PRECISIONS[to])}"
        raise JaxpendError(f"{text}{'' if to == 'onnx' else ' alone: leave it out'}")
    if to == "realaigym":
        return _submit(policy, out)
    _check_out(out)
    import jax

    from ..controllers.files import load_controller
    from ..terminal import console

    with jax.enable_x64(True):
        controller = load_controller(policy)
    content = _content(controller, to, out, chosen)
    from ..files import write_atomically

    write_atomically(out, content)
    text = f"wrote {out}, {len(content) / 1000:.0f} kB: one step of {policy}, {_use(to, out)}"
    console.print(text, soft_wrap=True)


def _submit(policy: str, out: Path) -> None:
    check_folder(out)
    from ..interop.realaigym import export
    from ..terminal import console

    found = export(policy, out)
    scores = f"score {found['score']:.4f}, robustness {found['robustness']:.3f}"
    text = f"wrote {out}, a submission of {policy} to RealAIGym: {scores}; see {out}/README.md"
    console.print(text, soft_wrap=True)


def _content(controller, to: str, out: Path, precision: str) -> str | bytes:
    if to == "numpy":
        from ..interop.numpy import source

        return source(controller)
    if to == "c":
        from ..interop import c

        return c.source(controller, prefix=_prefix(out), precision=precision)
    from ..interop.onnx import model

    return model(controller, precision=precision).SerializeToString()


def _prefix(out: Path) -> str:
    """The name of a file as C can have it."""
    name = re.sub(r"\W", "_", out.stem, flags=re.ASCII)
    return name if name[:1].isalpha() else f"controller_{name}"


def _use(to: str, out: Path) -> str:
    if to == "numpy":
        return "Controller().torque(t, x)"
    if to == "c":
        return f"{_prefix(out)}_init(&state) and {_prefix(out)}_step(&state, t, x, torque)"
    return "from t, x and the state to torque and the next state"


def _check_out(out: Path) -> None:
    """Refuse a file that could not be written, or that is there and is no exported one."""
    if str(out) == "-":
        raise JaxpendError("--out is -; a controller goes to a file, not to standard output")
    check_file(out)
    if out.is_file():
        with out.open("rb") as file:
            start = file.read(START)
        if start and not MARK.search(start):
            text = f"cannot write {out}: it is there and was not exported; choose another name"
            raise JaxpendError(text)

"""How jax is set up before a command computes: kept programs, and the platform asked for."""

import contextlib
import os
import sys
import warnings
from pathlib import Path
from typing import Any

from ..errors import JaxpendError
from ..fields import OFF, ON

__all__ = ["VARIABLE", "cache_folder", "check_platform", "compile_cache", "share_processor"]

VARIABLE = "JAXPEND_CACHE"
MOST = 32  # cores that are shared among


def cache_folder() -> Path | None:
    """Where to keep compiled programs; None: nowhere, or the user has told jax already."""
    said = os.environ.get(VARIABLE, "")
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or said.lower() in OFF:
        return None
    if said and said.lower() not in ON:
        return Path(said).expanduser()
    # The XDG specification: a relative path is invalid and ignored.
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    base = base if base.is_absolute() else Path("~/.cache").expanduser()
    return base / "jaxpend" / "xla"


def compile_cache() -> None:
    """Keep compiled programs for the next start. The one place that configures jax and XLA.

    What the environment says already has the last word. A folder that cannot be written is passed
    over, since nothing depends on it.
    """
    try:
        folder = cache_folder()
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            return
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return
    # XLA complains on every load on some CPUs, where it takes tuning hints for instructions.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    warnings.filterwarnings("ignore", message=".*persistent compilation cache")
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0.2,  # less is not worth a file
    }
    for name, value in settings.items():
        if name.upper() not in os.environ:
            os.environ[name.upper()] = str(value)
            if "jax" in sys.modules:  # python -m jaxpend.X: it has read its environment already
                sys.modules["jax"].config.update(name, value)


def share_processor() -> None:
    """Make a device of each core, for ``devices`` to share rollouts among.

    XLA's own threads share too little of a step. What the environment says has the last word.
    """
    said = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if said or "JAX_NUM_CPU_DEVICES" in os.environ:
        return
    jax = _jax()
    known = hasattr(os, "sched_getaffinity")  # not on macOS
    cores = len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1
    with contextlib.suppress(RuntimeError):  # whoever called has computed already
        jax.config.update("jax_num_cpu_devices", min(cores, MOST))


def _jax() -> Any:
    """jax. Raises ``JaxpendError`` where it does not take what the environment says."""
    try:
        import jax
    except ValueError as error:
        said = str(error).splitlines()[0]
        raise JaxpendError(f"jax does not take a variable of the environment: {said}") from None
    return jax


def check_platform() -> None:
    """Raise ``JaxpendError`` for devices, in the environment, that jax does not have here.

    Unasked, jax would say so in the middle of whatever is the first to compute.
    """
    jax = _jax()
    for name in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME", "JAX_NUM_CPU_DEVICES"):
        if os.environ.get(name):
            try:
                jax.devices()
            except (RuntimeError, AssertionError) as error:  # without a reason: nothing is there
                said = (str(error).strip() or "no reason given").splitlines()[0]
                text = f"{name} is {os.environ[name]!r}, which jax cannot use here: {said}"
                raise JaxpendError(text) from None

"""Train and judge controllers for the acrobot and the pendubot, end to end in JAX."""

# Nothing is imported here: until the command line begins, Ctrl-C is a traceback.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from . import rollout
    from .controllers.files import load_policy, save_policy
    from .controllers.policy import Policy
    from .errors import JaxpendError
    from .plant import Plant
    from .rollout import Trajectory, final_state
    from .scenario import Pulses, Scenario

__all__ = [
    "JaxpendError", "Plant", "Policy", "Pulses", "Scenario", "Trajectory", "final_state",
    "load_policy", "rollout", "save_policy",
]  # fmt: skip
__version__ = "0.14.0"

_HOME = {
    "JaxpendError": ".errors",
    "Plant": ".plant",
    "Policy": ".controllers.policy",
    "Pulses": ".scenario",
    "Scenario": ".scenario",
    "Trajectory": ".rollout",
    "final_state": ".rollout",
    "load_policy": ".controllers.files",
    "save_policy": ".controllers.files",
}


def __getattr__(name: str) -> "Any":
    """Names are imported when they are first asked for: a command's help must not wait for jax."""
    import importlib

    if name == "rollout":  # the module, which can be called
        return importlib.import_module(".rollout", __name__)
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name], __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

"""Train and judge controllers for the acrobot and the pendubot, end to end in JAX."""

import importlib
import sys
import types
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .controllers.policy import Policy, load_policy, save_policy
    from .errors import JaxpendError
    from .plant import Plant
    from .rollout import Trajectory, final_state, rollout
    from .scenario import Pulses, Scenario

__all__ = [
    "JaxpendError",
    "Plant",
    "Policy",
    "Pulses",
    "Scenario",
    "Trajectory",
    "final_state",
    "load_policy",
    "rollout",
    "save_policy",
]
__version__ = "0.2.0"

_MODULES = {
    ".controllers.policy": ("Policy", "load_policy", "save_policy"),
    ".errors": ("JaxpendError",),
    ".plant": ("Plant",),
    ".rollout": ("Trajectory", "final_state", "rollout"),
    ".scenario": ("Pulses", "Scenario"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


class _Package(types.ModuleType):
    """Names are imported when they are first asked for: a command's help must not wait for jax."""

    def __getattr__(self, name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(_HOME[name], self.__name__), name)
        super().__setattr__(name, value)
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # The import of the submodule rollout must not hide the function of the same name.
        if not (name in _HOME and isinstance(value, types.ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *_HOME})


sys.modules[__name__].__class__ = _Package

"""Policies that Stable-Baselines3 has trained, as policies of this package; torch is not needed.

``model.save`` of SAC or PPO (or of A2C, which acts as PPO does and is taken for it) writes a zip:
``policy.pth`` has the tensors, ``data`` the options as JSON, in which what JSON cannot hold is
pickled. Only tensors and plain JSON are read; see ``tensors`` for why no pickle in it can do
anything. The zip does not say what its environment showed the policy, nor its torque: that has to
be declared, a ``Convention``.
"""

import dataclasses
import json
import math
import re
import zipfile
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from ..config import Activation, EnvConfig
from ..controllers.policy import Policy
from ..errors import JaxpendError, choose
from ..fields import Checked, Period, Scale
from ..observation import History, Observation, Seen
from ..robots import ROBOTS
from .tensors import MOST_PICKLE, MOST_TENSORS, Name, StateDict, array, description, member, shown

__all__ = [
    "PRESETS", "Convention", "Model", "Statistics", "declared", "read_model", "read_statistics",
]  # fmt: skip

# What an environment may show: a kind of ``Observation``, and where each of its entries is there.
SEEN: dict[str, tuple[str, tuple[int, ...] | None]] = {
    "wrapped": ("wrapped", None),
    "sincos": ("sincos", None),
    "sincos_clipped": ("sincos_clipped", None),
    "sincos_by_joint": ("sincos_clipped", (0, 2, 1, 3, 4, 5)),
    "state": ("state", None),
    "angles": ("angles", None),
}
# The layers that act, hidden ones and the last, and all that a file with them may hold besides.
ACTORS = {
    "SAC": ("actor.latent_pi", "actor.mu", r"actor\.(latent_pi|mu|log_std)\b|critic(_target)?\."),
    "PPO": ("mlp_extractor.policy_net", "action_net",
            r"(mlp_extractor\.(policy|value)_net|(action|value|entropy|log_std)_net|log_std)\b"),
}  # fmt: skip
# What the library takes where a model says nothing else, and its names for what we have.
DEFAULT_ACTIVATION = {"SAC": "relu", "PPO": "tanh"}
ACTIVATION_OF = {"ReLU": "relu", "Tanh": "tanh", "SiLU": "silu"}
MOST_OPTIONS = 2**24  # bytes of JSON


LEAST, MOST = 1e-9, 1e9  # as those of ``Scale``


@dataclasses.dataclass(frozen=True)
class Convention(Checked):
    """What the environment was that a policy was trained in. Raises ``JaxpendError`` as fields do.

    ``wrapped`` is (theta mod 2 pi - pi) / pi of both angles and clipped velocities,
    ``sincos`` (cos theta1, cos theta2, sin theta1, sin theta2) and velocities,
    ``sincos_clipped`` the same with clipped velocities, ``sincos_by_joint`` the same in the order
    (cos theta1, sin theta1, cos theta2, sin theta2), ``state`` angles as they are and velocities,
    ``angles`` cosines and sines alone. What was seen of the past is as ``Observation`` has it.
    """

    observation: Seen
    max_velocity: Scale  # rad/s, velocities are divided by it, and clipped there if clipped
    torque_limit: Scale  # N m, torque at the largest action
    statistics: str | None = None  # file, see ``read_statistics``; None: it does not normalise
    squash: Literal["tanh", "clip"] | None = None  # of the mean action; None: as the library does
    activation: Activation | None = None  # None: as the zip says
    history: History = 0  # past states and actions that it sees too
    control_dt: Period | None = None  # s, how far apart they are
    max_turn: Scale = 0.1  # rad, what ``angles`` sees of the past is divided by it

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.history:
            return
        if self.control_dt is None:
            raise JaxpendError(f"history is {self.history}; declare control_dt, its period, too")
        if self.statistics or SEEN[self.observation][1]:
            what = "running statistics" if self.statistics else f"observation {self.observation!r}"
            raise JaxpendError(f"history is {self.history}; with {what} it must be 0")


# What the authors of published policies declared: the form of the observation in gym_env.py of the
# reference (state_representation 2), the numbers in con_evolsac.py and con_ar_eapo.py of its v2
# boards. AR-EAPO's policy class squashes by tanh and has its statistics beside the zip.
# What our own Gymnasium environments show by default is a preset too.
OURS = EnvConfig()
PRESETS: dict[str, dict[str, Any]] = {
    "evolsac": {"observation": "wrapped", "max_velocity": 50.0, "torque_limit": 3.0},
    "ar_eapo": {"observation": "wrapped", "max_velocity": 20.0, "torque_limit": 6.0,
                "statistics": "vec_normalize_env.pkl", "squash": "tanh"},
    "gymnasium": {"observation": OURS.observation.kind, "torque_limit": OURS.torque_limit,
                  "max_velocity": OURS.observation.max_velocity},
}  # fmt: skip


def declared(path: str | Path, preset: str | None = None, **given: Any) -> Convention:
    """The convention of a preset, of what is given (fields, None where it is not), or of both.

    Raises ``JaxpendError`` for an unknown preset, and if anything is missing that a zip does not
    say and no preset either.
    """
    values = dict(PRESETS[choose("preset", preset, PRESETS)]) if preset else {}
    if "statistics" in values:
        values["statistics"] = str(Path(path).with_name(values["statistics"]))
    values |= {name: value for name, value in given.items() if value is not None}
    missing = {"observation", "max_velocity", "torque_limit"} - values.keys()
    if missing:
        text = f"declare {', '.join(sorted(missing))}, which {path} does not say"
        raise JaxpendError(f"{text}, or a preset: {', '.join(PRESETS)}")
    return Convention(**values)


class Model(NamedTuple):
    """What a zip holds."""

    policy: Policy
    algorithm: str  # "SAC" or "PPO"
    library: str  # "Stable-Baselines3" and its version


def read_model(path: str | Path, robot: str, convention: Convention) -> Model:
    """The policy in a zip of SAC or PPO; its greedy action, as ``predict(deterministic=True)``.

    Weights are float32, as they are in the zip.

    Args:
        path: what ``model.save`` wrote.
        robot: "acrobot" or "pendubot"; the zip does not say it.
        convention: what its environment was.

    Raises:
        JaxpendError: no such file, not such a zip, another algorithm or network, something in it
            that has no place there, or an observation or activation that does not fit.
    """
    choose("robot", robot, ROBOTS)
    statistics = convention.statistics and read_statistics(convention.statistics)
    try:
        if Path(path).is_char_device():  # /dev/zero has no end
            raise OSError
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if "policy.pth" not in names or "data" not in names:
                raise JaxpendError("it is a zip, but no model that Stable-Baselines3 has saved")
            options = json.loads(member(archive, "data", MOST_OPTIONS))
            state = StateDict(member(archive, "policy.pth", MOST_TENSORS))
            library = "Stable-Baselines3"
            if "_stable_baselines3_version" in names:
                library += f" {member(archive, '_stable_baselines3_version', 64).decode().strip()}"
        algorithm = _algorithm(state)
        policy = _policy(options, _layers(state, algorithm), algorithm, robot, convention)
        policy = _normalised(policy, convention, statistics) if statistics else policy
    except FileNotFoundError:
        raise JaxpendError(f"there is no model {path}") from None
    except JaxpendError as error:
        raise JaxpendError(f"{path}: {error}") from None
    except Exception:  # zipfile, json and numpy raise a dozen kinds for bytes that are not theirs
        text = f"{path} is not a model of Stable-Baselines3, or it is empty, cut off or damaged"
        raise JaxpendError(text) from None
    return Model(policy, algorithm, library)


def _algorithm(state: StateDict) -> str:
    """Which algorithm a file is of, if its actor is a plain network."""
    for name, (_, last, known) in ACTORS.items():
        if f"{last}.weight" in state:
            others = [layer for layer in state if not re.match(known, layer)]
            if not others:
                return name
            raise JaxpendError(f"it has a layer {shown(others[0])}, which plain {name} does not")
    found = ", ".join(list(dict.fromkeys(shown(name.rpartition(".")[0]) for name in state))[:3])
    ours = " or ".join(f"{name} ({first}, {last})" for name, (first, last, _) in ACTORS.items())
    raise JaxpendError(f"its layers are {found or 'none'}, ...; those of {ours} can be read")


def _layers(state: StateDict, algorithm: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernel (in, out) and bias (out,) of the layers that act."""
    first, last, _ = ACTORS[algorithm]
    numbers = sorted(
        int(found[1]) for name in state if (found := re.fullmatch(rf"{first}\.(\d+)\.weight", name))
    )
    if numbers != list(range(0, 2 * len(numbers), 2)):  # between them are activations
        raise JaxpendError(f"the layers of {first} are not linear ones and activations by turns")
    layers: list[tuple[np.ndarray, np.ndarray]] = []
    for name in (*(f"{first}.{number}" for number in numbers), last):
        weight, bias = state.read(f"{name}.weight"), state.read(f"{name}.bias")
        wide = layers[-1][1].shape if layers else weight.shape[1:]
        if weight.shape != (*bias.shape, *wide) or weight.ndim != 2:
            raise JaxpendError(f"{name} is not a linear layer that fits the one before it")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise JaxpendError(f"{name} holds values that are not finite")
        layers.append((weight.T, bias))
    return layers


def _policy(
    options: dict[str, Any],
    layers: list[tuple[np.ndarray, np.ndarray]],
    algorithm: str,
    robot: str,
    convention: Convention,
) -> Policy:
    seen = options.get("observation_space", {})
    if ".Box" not in str(seen.get(":type:", ".Box")):
        raise JaxpendError("its observation is not one vector of numbers, a Box")
    keywords = options.get("policy_kwargs") or {}
    kind, order = SEEN[convention.observation]
    view = Observation(
        kind,  # type: ignore[arg-type]
        convention.max_velocity,
        convention.history,
        max_turn=convention.max_turn,
    )
    kernel, (last, last_bias) = layers[0][0], layers[-1]
    if len(kernel) != view.size:
        past = f" with history {convention.history}" if convention.history else ""
        said = f"its network sees {len(kernel)} numbers, {convention.observation!r}{past}"
        said += f" is {view.size}"
        raise JaxpendError(f"{said}; declare the observation that it was trained with")
    if len(last_bias) != 1:
        raise JaxpendError(f"it has {len(last_bias)} actions; one is read, of the driven joint")
    if "FlattenExtractor" not in str(keywords.get("features_extractor_class", "FlattenExtractor")):
        raise JaxpendError("it has a features extractor of its own; a plain network is read")
    squash, bound = _squash(options, keywords, algorithm, convention), _bound(options)
    if squash == "clip":  # at the ends of the action space; what tanh gives is scaled to them
        layers[-1] = last / bound, last_bias / bound
    if order is not None:
        layers[0] = layers[0][0][list(order)], layers[0][1]
    policy = Policy(
        layers=tuple((jnp.asarray(w), jnp.asarray(b)) for w, b in layers),
        torque_limit=jnp.asarray(convention.torque_limit, jnp.float32),
        robot=robot,
        observation=view,
        activation=_activation(keywords, algorithm, convention),
        squash=squash,
    )
    period = convention.control_dt
    return policy if period is None else policy.replace(control_dt=period)


def _normalised(policy: Policy, convention: Convention, statistics: "Statistics") -> Policy:
    """The same of an observation that is normalised by statistics in the order of the zip."""
    mean, std, clip = statistics
    order = SEEN[convention.observation][1]
    if order is not None and len(mean) == len(order):
        mean, std = mean[list(order)], std[list(order)]
    view = dataclasses.replace(policy.observation, mean=mean.tolist(), std=std.tolist(), clip=clip)
    return policy.replace(observation=view)


def _activation(keywords: dict[str, Any], algorithm: str, convention: Convention) -> str:
    """That which is declared, or which the options name as ``<class 'torch....ReLU'>``."""
    if convention.activation is not None:
        return convention.activation
    said = keywords.get("activation_fn_pi", keywords.get("activation_fn"))
    if said is None:
        return DEFAULT_ACTIVATION[algorithm]
    name = str(said).rstrip("'>").rpartition(".")[2]
    if name not in ACTIVATION_OF:
        raise JaxpendError(f"its activation is {shown(name)}; known: {', '.join(ACTIVATION_OF)}")
    return ACTIVATION_OF[name]


def _squash(
    options: dict[str, Any], keywords: dict[str, Any], algorithm: str, convention: Convention
) -> str:
    """How the mean becomes an action in [-1, 1]: SAC by tanh; PPO clips it, unless it says so."""
    if algorithm == "SAC":
        if convention.squash == "clip":
            raise JaxpendError("it is of SAC, which squashes by tanh, not clip")
        return "tanh"
    if convention.squash is not None:
        return convention.squash
    module = str((options.get("policy_class") or {}).get("__module__", ""))
    if not module.startswith("stable_baselines3."):
        text = f"its policy is of a class of {shown(module) or 'unknown origin'}"
        raise JaxpendError(f"{text}; declare whether that squashes actions by tanh or clip")
    return "tanh" if keywords.get("squash_output") is True else "clip"


def _bound(options: dict[str, Any]) -> float:
    """The largest action; the smallest must be its opposite."""
    space = options["action_space"]
    low, high = (float(str(space[end]).strip("[] ")) for end in ("low", "high"))
    if not (LEAST <= high <= MOST and low == -high):
        text = f"they must be symmetric, and the largest {LEAST:g} to {MOST:g}"
        raise JaxpendError(f"its actions are from {low:g} to {high:g}; {text}")
    return high


# What a VecNormalize is pickled with; all of it stays names.
LIBRARIES = ("stable_baselines3", "gymnasium", "gym", "numpy", "collections")


class Statistics(NamedTuple):
    """Of the observations of a run."""

    mean: np.ndarray  # (n,)
    std: np.ndarray  # (n,)
    clip: float | None  # largest magnitude of what is normalised


def read_statistics(path: str | Path) -> Statistics:
    """The running statistics that observations were normalised by.

    Args:
        path: what ``VecNormalize.save`` wrote, which is not unpickled but read as ``tensors``
            says; or a .npz of ``mean`` (n,), ``var`` (n,) and, if they are not 1e-8 and 10,
            ``epsilon`` and ``clip``.

    Raises:
        JaxpendError: no such file, neither of both, one that names what has no place there, or
            one that does not normalise observations.
    """
    try:
        with Path(path).open("rb") as file:
            content = file.read(MOST_PICKLE + 1)
        found = _arrays(path) if content[:2] == b"PK" else _vec_normalize(content)
        mean, var = found["mean"], found["var"]
        epsilon, clip = float(found["epsilon"]), float(found["clip"])
        std = np.sqrt(var + epsilon)
        fits = mean.ndim == 1 and mean.shape == var.shape and (var >= 0).all() and epsilon > 0
        fits = fits and (abs(mean) <= MOST).all() and (std >= LEAST).all() and (std <= MOST).all()
        if not (fits and clip >= LEAST):
            raise ValueError("no statistics")
    except FileNotFoundError:
        raise JaxpendError(f"there are no running statistics {path}") from None
    except JaxpendError as error:
        raise JaxpendError(f"{path}: {error}") from None
    except Exception:  # whatever zipfile and numpy raise for bytes that are not theirs
        text = f"{path} holds no running statistics of observations, or it is cut off or damaged"
        raise JaxpendError(f"{text}; a VecNormalize or a .npz of mean and var is read") from None
    return Statistics(mean, std, clip if math.isfinite(clip) else None)


def _vec_normalize(content: bytes) -> dict[str, np.ndarray]:
    def expected(name: Name) -> bool:
        return str(name.module).partition(".")[0] in LIBRARIES

    whole = description(content, expected)
    if whole.function.name != "VecNormalize":
        raise ValueError("no VecNormalize")
    if whole.state.get("norm_obs", True) is not True:
        raise JaxpendError("it does not normalise observations; leave it out")
    moments = whole.state["obs_rms"].state
    names = {"epsilon": whole.state["epsilon"], "clip": whole.state["clip_obs"]}
    names |= {"mean": moments["mean"], "var": moments["var"]}
    return {name: array(described) for name, described in names.items()}


def _arrays(path: str | Path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        sizes = [info.file_size for info in archive.infolist()]
    if sum(sizes) > MOST_PICKLE:
        raise JaxpendError(f"it has {sum(sizes):,} bytes; at most {MOST_PICKLE:,} are read")
    with np.load(path, allow_pickle=False) as file:
        found = {name: np.asarray(values, float) for name, values in file.items()}
    return {"epsilon": np.array(1e-8), "clip": np.array(10.0)} | found

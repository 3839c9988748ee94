"""Files as Stable-Baselines3 and torch write them, written by hand: no torch is installed here.

The formats are those of torch 1.6 and later (``torch.save``) and Stable-Baselines3 2
(``model.save``, ``VecNormalize.save``).
"""

import io
import json
import struct
import zipfile

import numpy as np

STORAGE = {"f4": "FloatStorage", "f8": "DoubleStorage", "f2": "HalfStorage", "i8": "LongStorage"}
RELU, TANH = (f"<class 'torch.nn.modules.activation.{name}'>" for name in ("ReLU", "Tanh"))


def text(value):
    """A BINUNICODE instruction."""
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def integer(value):
    """A BININT instruction."""
    return b"J" + struct.pack("<i", value)


def tuple_of(*parts):
    """A MARK, the parts, and a TUPLE instruction."""
    return b"(" + b"".join(parts) + b"t"


def name(module, what):
    """A GLOBAL instruction."""
    return f"c{module}\n{what}\n".encode()


def tensor(key, values, *, shape=None, strides=None, offset=0, count=None):
    """The instructions that torch writes for a tensor in storage ``key``."""
    values = np.asarray(values)
    shape = values.shape if shape is None else shape
    steps = [step // values.itemsize for step in values.strides] if strides is None else strides
    kind = STORAGE[values.dtype.str[1:]]
    count = values.size if count is None else count
    storage = tuple_of(text("storage"), name("torch", kind), text(key), text("cpu"), integer(count))
    size, steps = (tuple_of(*map(integer, numbers)) for numbers in (shape, steps))
    hooks = name("collections", "OrderedDict") + b")R"
    parts = storage + b"Q", integer(offset), size, steps, b"\x89", hooks
    return name("torch._utils", "_rebuild_tensor_v2") + tuple_of(*parts) + b"R"


def state_dict(tensors, *, pickled=None, order=b"little", compression=zipfile.ZIP_STORED, **odd):
    """``torch.save`` of tensors by name; ``odd`` are arguments of ``tensor`` for all of them.

    ``pickled`` are instructions in place of the dict.
    """
    items = b"".join(
        text(key) + tensor(str(i), v, **odd) for i, (key, v) in enumerate(tensors.items())
    )
    made = name("collections", "OrderedDict") + b")R(" + items + b"u"
    metadata = b"}" + text("_metadata") + name("collections", "OrderedDict") + b")Rsb"
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + (pickled or made + metadata) + b".")
        archive.writestr("archive/byteorder", order)
        for i, values in enumerate(tensors.values()):
            values = np.asarray(values)
            swapped = values.astype(values.dtype.newbyteorder(">" if order == b"big" else "<"))
            archive.writestr(f"archive/data/{i}", swapped.tobytes())
        archive.writestr("archive/version", b"3\n")
    return file.getvalue()


def network(layers, algorithm, **others):
    """Tensors by name of the actor of SAC or PPO, and of a critic, with (kernel, bias) layers."""
    hidden, last = {"SAC": ("actor.latent_pi", "actor.mu"),
                    "PPO": ("mlp_extractor.policy_net", "action_net")}[algorithm]  # fmt: skip
    names = [*(f"{hidden}.{2 * i}" for i in range(len(layers) - 1)), last]
    found = {}
    for place, (kernel, bias) in zip(names, layers, strict=True):
        found |= {f"{place}.weight": np.ascontiguousarray(np.asarray(kernel).T, "f4")}
        found |= {f"{place}.bias": np.asarray(bias, "f4")}
    if algorithm == "SAC":
        found |= {
            "actor.log_std.weight": np.zeros((1, 2), "f4"),
            "critic.qf0.0.bias": np.ones(2, "f4"),
        }
    else:
        found |= {"log_std": np.zeros(1, "f4"), "value_net.bias": np.ones(1, "f4")}
    return found | others


def options(**changes):
    """What ``data`` says, as far as it is of interest."""
    box = {
        ":type:": "<class 'gymnasium.spaces.box.Box'>",
        ":serialized:": "gAUu",
        "dtype": "float32",
    }
    return {
        "policy_class": {":serialized:": "gAUu", "__module__": "stable_baselines3.sac.policies"},
        "policy_kwargs": {"use_sde": False},
        "action_space": box | {"_shape": [1], "low": "[-1.]", "high": "[1.]"},
    } | changes


def model(path, tensors, *, policy=None, data=None, **changes):
    """``model.save``: tensors, or the bytes of ``policy.pth``, and changes of ``options``."""
    with zipfile.ZipFile(path, "w") as archive:
        said = json.dumps(options(**changes)) if data is None else data
        archive.writestr("data", said)
        archive.writestr("policy.pth", state_dict(tensors) if policy is None else policy)
        archive.writestr("_stable_baselines3_version", "2.3.2")
    return path

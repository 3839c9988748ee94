"""Tensors out of PyTorch and numpy pickles, without torch and without unpickling.

A pickle is a program: to unpickle one runs it, and it may do anything. Here its instructions are
read as a description instead. A name such as ``torch.FloatStorage`` stays a ``Name``, which is
only ever compared; what would be called stays a ``Call``; nothing is imported and nothing is run.
A name that is not expected is refused, since then the file is not what it says it is.
"""

import dataclasses
import io
import math
import pickletools
import zipfile
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..errors import JaxpendError

__all__ = [
    "MOST_PICKLE", "MOST_TENSORS", "Call", "Name", "StateDict", "array", "description", "member",
    "shown",
]  # fmt: skip

MOST_PICKLE = 2**20  # bytes of a pickle that is described; those of real models have some 5 kB
MOST_AXES = 8  # of a tensor
MOST_TENSORS = 2**27  # bytes of a file of tensors; those of the published models have 1.4 MB


class Name(NamedTuple):
    """A class or function that a pickle names."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


def shown(text: Any) -> str:
    """Text of a file as it may stand in a sentence: not long, and in one line."""
    return repr(str(text)[:80])[1:-1]


@dataclasses.dataclass(eq=False)
class Call:
    """What a pickle would call, with what, and the state that the result would be given."""

    function: Any
    arguments: Any
    state: Any = None


MARK = object()
ORDERED = Name("collections", "OrderedDict")
PERSISTENT = Name("", "persistent")  # how torch names a storage
# Instructions that say a value; and how many of the last values a tuple is made of.
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
LITERALS = {
    "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE",
    "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8",
}  # fmt: skip
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


class _Reader:
    """The values that the instructions so far describe."""

    def __init__(self, expected: Callable[[Name], bool]):
        self.expected, self.stack, self.memo = expected, list[Any](), dict[int, Any]()

    def pop(self, count: int = 1) -> list[Any]:
        """The last values, in their order."""
        if len(self.stack) < count:
            raise ValueError("too few values")
        last = self.stack[-count:]
        del self.stack[-count:]
        return last

    def since_mark(self) -> list[Any]:
        """The values behind the last mark, which goes away too."""
        place = len(self.stack) - 1 - self.stack[::-1].index(MARK)
        values = self.stack[place + 1 :]
        del self.stack[place:]
        return values

    def named(self, module: Any, name: Any) -> Name:
        """A name, if it is an expected one."""
        if not (isinstance(module, str) and isinstance(name, str)):
            raise ValueError("no name")
        found = Name(module, name)
        if not self.expected(found):
            raise JaxpendError(
                f"it names {shown(found)}, which has no place in it; nothing was run"
            )
        return found

    def build(self, state: Any) -> None:
        """The last value is given a state."""
        if isinstance(self.stack[-1], Call):
            self.stack[-1].state = state
        elif not isinstance(self.stack[-1], dict):  # of an ordered dict, what else it has
            raise ValueError("no object")

    def put(self, values: list[Any]) -> None:
        """Keys and values by turns into the last value, a dict."""
        if len(values) % 2 or not isinstance(self.stack[-1], dict):
            raise ValueError("no items of a dict")
        for key, value in zip(values[::2], values[1::2], strict=True):
            if not isinstance(key, str | int | None):  # others could be slow to compare
                raise ValueError("a key that is no text")
            self.stack[-1][key] = value

    def step(self, name: str, argument: Any) -> None:
        """One instruction; its names are those of ``pickletools``."""
        stack = self.stack
        if name in ("PROTO", "FRAME"):
            return
        if name in LITERALS:
            stack.append(argument)
        elif name in CONSTANTS:
            stack.append(CONSTANTS[name])
        elif name == "MARK":
            stack.append(MARK)
        elif name in TUPLES:
            stack.append(tuple(self.pop(TUPLES[name])))
        elif name == "TUPLE":
            stack.append(tuple(self.since_mark()))
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(self.memo[argument])
        elif name in ("BINPUT", "LONG_BINPUT"):
            self.memo[argument] = stack[-1]
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = stack[-1]
        else:
            self.make(name, argument)

    def make(self, name: str, argument: Any) -> None:
        """An instruction about names, calls and containers."""
        if name == "GLOBAL":
            self.stack.append(self.named(*argument.split(" ", 1)))
        elif name == "STACK_GLOBAL":
            self.stack.append(self.named(*self.pop(2)))
        elif name in ("REDUCE", "NEWOBJ"):
            function, arguments = self.pop(2)
            self.stack.append({} if function == ORDERED else Call(function, arguments))
        elif name == "BINPERSID":
            self.stack.append(Call(PERSISTENT, self.pop()[0]))
        elif name == "BUILD":
            self.build(self.pop()[0])
        elif name in ("EMPTY_DICT", "EMPTY_LIST"):
            self.stack.append({} if name == "EMPTY_DICT" else [])
        elif name in ("SETITEM", "SETITEMS"):
            self.put(self.pop(2) if name == "SETITEM" else self.since_mark())
        elif name in ("APPEND", "APPENDS"):
            values = self.pop() if name == "APPEND" else self.since_mark()
            self.stack[-1].extend(values)
        else:
            raise ValueError(f"instruction {name}")


def description(content: bytes, expected: Callable[[Name], bool]) -> Any:
    """What a pickle describes: numbers, text, tuples, lists, dicts, ``Name`` and ``Call``.

    Args:
        content: the pickle, of any protocol that Python 3 writes by itself.
        expected: which names may be in it.

    Raises:
        JaxpendError: a name that is not expected, or more than ``MOST_PICKLE`` bytes.
        Exception: of any kind, for bytes that are not such a pickle.
    """
    if len(content) > MOST_PICKLE:
        raise JaxpendError(f"it has {len(content):,} bytes; at most {MOST_PICKLE:,} are read")
    reader = _Reader(expected)
    for instruction, argument, _ in pickletools.genops(content):
        if instruction.name == "STOP":
            break
        reader.step(instruction.name, argument)
    return reader.pop()[0]


def array(described: Any) -> np.ndarray:
    """The numbers, of any shape, of a numpy array or scalar that a pickle describes, as float64.

    Raises an exception of any kind for what is not one.
    """
    if isinstance(described, int | float):
        return np.array(described, float)
    name = described.function.name
    if name == "scalar":
        dtype, content = described.arguments
        shape: tuple[int, ...] = ()
    elif name == "_frombuffer":  # protocol 5
        content, dtype, shape, order = described.arguments
        if order != "C" and len(shape) > 1:
            raise ValueError("order")
    else:  # _reconstruct, and then its state
        _, shape, dtype, fortran, content = described.state
        if fortran and len(shape) > 1:
            raise ValueError("order")
    order = dtype.state[1] if dtype.state else "<"
    code = {"f4": "f4", "f8": "f8"}[dtype.arguments[0].lstrip("<>=|")]
    dtype = np.dtype(("" if order in "|=" else order) + code)
    return np.frombuffer(content, dtype).reshape(shape).astype(float)


def member(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """A file in an archive, of at most so many bytes.

    Raises ``JaxpendError`` if it says that it has more, and what ``zipfile`` raises.
    """
    info = archive.getinfo(name)
    if info.file_size > most:
        raise JaxpendError(f"{name} in it has {info.file_size:,} bytes; at most {most:,} are read")
    return archive.read(info)


STORAGES = {"FloatStorage": "f4", "DoubleStorage": "f8", "HalfStorage": "f2"}
OTHERS = ("BFloat16", "Bool", "Byte", "Char", "Int", "Long", "Short")  # known, but not read
TENSOR = Name("torch._utils", "_rebuild_tensor_v2")


def _is_of_tensors(name: Name) -> bool:
    storages = [*STORAGES, *(f"{other}Storage" for other in OTHERS)]
    return name in (ORDERED, TENSOR) or (name.module == "torch" and name.name in storages)


class StateDict:
    """The tensors by name in what ``torch.save`` wrote of a module's ``state_dict``.

    The format is that of torch 1.6 and later: a zip of ``data.pkl``, which names and describes the
    tensors, and a file of plain numbers for each storage.

    Raises:
        JaxpendError: it names something else than tensors, or is too large.
        Exception: of any kind, for bytes that are not such a file.
    """

    def __init__(self, content: bytes):
        self.archive = zipfile.ZipFile(io.BytesIO(content))
        (pickle,) = [n for n in self.archive.namelist() if n.split("/")[1:] == ["data.pkl"]]
        self.folder, names = pickle.split("/")[0], self.archive.namelist()
        order = f"{self.folder}/byteorder"
        big = order in names and member(self.archive, order, 16) == b"big"
        self.order = ">" if big else "<"
        self.tensors = description(member(self.archive, pickle, MOST_PICKLE), _is_of_tensors)
        if not all(isinstance(name, str) for name in self.tensors):
            raise ValueError("names")

    def __contains__(self, name: str) -> bool:
        return name in self.tensors

    def __iter__(self):
        return iter(self.tensors)

    def read(self, name: str) -> np.ndarray:
        """The numbers of a tensor, of its shape, as float32. Raises as the class does."""
        tensor = self.tensors[name]
        if tensor.function != TENSOR:
            raise ValueError("no tensor")
        storage, offset, shape, strides = tensor.arguments[:4]
        said, kind, key, _, count = storage.arguments
        numbers = [offset, count, *shape, *strides]
        whole = all(type(n) is int and 0 <= n <= MOST_TENSORS for n in numbers)
        # What is text must be, since other things that a pickle holds can be too long to write.
        if not (whole and said == "storage" and isinstance(key, str) and len(shape) <= MOST_AXES):
            raise ValueError("storage")
        if kind.name not in STORAGES:
            known = ", ".join(STORAGES)
            raise JaxpendError(f"{name} is of {shown(kind.name)}; those that are read: {known}")
        dtype = np.dtype(self.order + STORAGES[kind.name])
        content = member(self.archive, f"{self.folder}/data/{key}", MOST_TENSORS)
        last = offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
        # A view may not have more numbers than there are, nor reach beyond them.
        few = 0 not in shape and math.prod(shape) <= count and last < count
        if not (few and len(content) == count * dtype.itemsize):
            raise ValueError("shape")
        flat = np.frombuffer(content, dtype)[offset:]
        steps = [step * dtype.itemsize for step in strides]
        return np.lib.stride_tricks.as_strided(flat, shape, steps).astype(np.float32)

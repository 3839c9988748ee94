"""A controller as an ONNX model, for ONNX Runtime and others: state in and out.

Inputs are ``t`` (), s, ``x`` (4,), the measured state, and what is remembered, ``s0``, ``s1``, ...;
outputs ``torque`` (2,), N m, and what is remembered after it, ``next_s0``, ... A run begins
without any ``s``: those that are not given have the values after a reset. (ONNX Runtime warns of
that when it loads the model: they could be constants. ``log_severity_level = 3`` is quiet.)

    session = onnxruntime.InferenceSession("pendubot.onnx")
    state = {}
    torque, *after = session.run(None, {"t": t, "x": x, **state})  # every period of the control
    state = {f"s{i}": value for i, value in enumerate(after)}

On the same measurements, in float64, the torques are those of the controller to about 1e-10 N m;
in float32 they differ by rounding, as much as those of ``interop.c``.
"""

import hashlib
from typing import Any

import numpy as np

from ..controller import Controller
from ..errors import JaxpendError
from .program import Node, Program, is_constant
from .trace import trace

__all__ = ["model"]

OPSET, IR = 18, 9  # of 2022 and 2023: what is not brand-new reads them
OPERATORS = {
    "add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div", "neg": "Neg", "abs": "Abs",
    "max": "Max", "min": "Min", "sign": "Sign", "floor": "Floor", "ceil": "Ceil",
    "round": "Round", "sqrt": "Sqrt", "exp": "Exp", "log": "Log", "sin": "Sin", "cos": "Cos",
    "tanh": "Tanh", "lt": "Less", "le": "LessOrEqual", "gt": "Greater",
    "ge": "GreaterOrEqual", "eq": "Equal", "and": "And", "or": "Or", "not": "Not",
    "select": "Where",
}  # fmt: skip
ROWS = {"total": "ReduceSum", "largest": "ReduceMax", "smallest": "ReduceMin"}


def model(controller: Controller, *, precision: str = "float64") -> Any:
    """The ``onnx.ModelProto``; ``SerializeToString()`` gives the content of a file.

    Policies act without their ``action_noise``.

    Args:
        controller: any that can be traced.
        precision: "float64" or "float32".

    Raises:
        JaxpendError: as ``trace.trace``, or onnx is not installed.
    """
    try:
        import onnx
    except ImportError:
        raise JaxpendError("there is no onnx here; pip install 'jaxpend[onnx]'") from None
    program = trace(controller, precision)
    found = _Graph(program).model()
    onnx.checker.check_model(found, full_check=True)
    return found


class _Graph:
    """The nodes and initializers of a model."""

    def __init__(self, program: Program):
        from onnx import TensorProto, helper

        self.helper, self.program = helper, program
        single = program.precision == "float32"
        self.types = program.types
        self.tensors = {
            "float": TensorProto.FLOAT if single else TensorProto.DOUBLE,
            "int": TensorProto.INT64,
            "bool": TensorProto.BOOL,
        }
        self.nodes: list[Any] = []
        self.initializers: dict[str, Any] = {}
        self.names: dict[Node, str] = {}

    def model(self) -> Any:
        """All of it."""
        info, floats = self.helper.make_tensor_value_info, self.tensors["float"]
        inputs, outputs = [info("t", floats, []), info("x", floats, [4])], []
        for number, leaf in enumerate(self.program.state):
            kind, shape = self.tensors[leaf.kind], [leaf.initial.size]
            inputs.append(info(f"s{number}", kind, shape))
            outputs.append(info(f"next_s{number}", kind, shape))
            self.initial(f"s{number}", leaf.initial.astype(self.types[leaf.kind]))
        for node in self.program.nodes:
            if node.op != "constant":
                self.names[node] = self.computed(node)
        self.packed(self.program.torque, "torque")
        for number, (leaf, after) in enumerate(
            zip(self.program.state, self.program.next_state, strict=True)
        ):
            if leaf.scalar:
                self.packed(after, f"next_s{number}")
            else:
                self.put("Identity", [self.name(after[0])], name=f"next_s{number}")
        outputs.insert(0, info("torque", floats, [2]))
        # A constant that only products read is there as a matrix; nothing reads its flat form.
        used = {name for node in self.nodes for name in node.input} | {i.name for i in inputs}
        initial = [tensor for name, tensor in self.initializers.items() if name in used]
        graph = self.helper.make_graph(self.nodes, "controller", inputs, outputs, initial)
        about = f"The controller {self.program.name}; see jaxpend.interop.onnx."
        return self.helper.make_model(
            graph, producer_name="jaxpend", doc_string=about, ir_version=IR,
            opset_imports=[self.helper.make_opsetid("", OPSET)],
        )  # fmt: skip

    def initial(self, name: str, value: np.ndarray) -> str:
        """Enter numbers under a name."""
        from onnx import numpy_helper

        self.initializers[name] = numpy_helper.from_array(np.asarray(value), name)
        return name

    def numbers(self, value: Any, kind: str = "int") -> str:
        """The name of some numbers."""
        array = np.asarray(value, self.types[kind])
        form = "x".join(map(str, array.shape)) or "scalar"
        name = f"{kind}_{form}_{array.tobytes().hex()}"
        if len(name) > 60:
            name = f"table_{hashlib.sha256(name.encode()).hexdigest()[:16]}"
        return name if name in self.initializers else self.initial(name, array)

    def name(self, node: Node) -> str:
        """Of a node that is computed, or of a constant."""
        if node.op == "constant":
            return self.numbers(node.value, node.kind)
        return self.names[node]

    def put(self, operator: str, inputs: list[str], name: str | None = None, **attributes) -> str:
        """Enter an operation; the name of its result."""
        name = name or f"v{len(self.nodes)}"
        self.nodes.append(self.helper.make_node(operator, inputs, [name], **attributes))
        return name

    def packed(self, scalars: tuple[Node, ...], name: str | None = None) -> str:
        """The vector of some scalars."""
        axis = self.numbers([0])
        parts = [self.put("Unsqueeze", [self.name(node), axis]) for node in scalars]
        return self.put("Concat", parts, name, axis=0)

    def computed(self, node: Node) -> str:
        """The name of a node, whose arguments have theirs."""
        if node.op == "t":
            return "t"
        if node.op == "x":
            return self.put("Gather", ["x", self.numbers(node.value)])
        if node.op == "state":
            number, place = node.value
            leaf = f"s{number}"
            return leaf if place is None else self.put("Gather", [leaf, self.numbers(place)])
        args = [self.name(arg) for arg in node.args]
        if node.op in OPERATORS:
            return self.put(OPERATORS[node.op], args)
        if node.op == "item":
            return self.put("Gather", [args[0], self.numbers(node.value)])
        if node.op == "take":
            return self.put("Gather", args)
        if node.op == "pack":
            return self.packed(node.args)
        if node.op == "concat":
            return self.put("Concat", args, axis=0)
        if node.op == "matmul":
            return self.product(node)
        if node.op in ROWS:
            rows = self.put("Reshape", [args[0], self.numbers(node.value)])
            return self.put(ROWS[node.op], [rows, self.numbers([1])], keepdims=0)
        if node.op == "sums":
            rows = self.put("Reshape", [args[0], self.numbers(node.value)])
            sums = self.put("CumSum", [rows, self.numbers(1)])
            return self.put("Reshape", [sums, self.numbers([node.size])])
        return self.composed(node, args)

    def product(self, node: Node) -> str:
        """A product of matrices, flat."""
        m, k, n = node.value
        factors = []
        for arg, shape in zip(node.args, ((m, k), (k, n)), strict=True):
            if is_constant(arg):
                factors.append(self.numbers(arg.value.reshape(shape), "float"))
            else:
                factors.append(self.put("Reshape", [self.name(arg), self.numbers(shape)]))
        product = self.put("MatMul", factors)
        return self.put("Reshape", [product, self.numbers([m * n])])

    def arctangent(self, args: list[str]) -> str:
        """Of a float, and one step from it towards that of ``args``: runtimes have no other."""
        short = self.put("Atan", [self.put("Cast", args, to=1)])
        first = self.put("Cast", [short], to=self.tensors["float"])
        sin, cos = self.put("Sin", [first]), self.put("Cos", [first])
        # tan(a - b) = (tan a - tan b) / (1 + tan a tan b)
        above = self.put("Sub", [self.put("Mul", [*args, cos]), sin])
        below = self.put("Add", [cos, self.put("Mul", [*args, sin])])
        better = self.put("Add", [first, self.put("Div", [above, below])])
        return self.put("Where", [self.put("IsInf", args), first, better])

    def composed(self, node: Node, args: list[str]) -> str:
        """What ONNX has no operator of its own for."""
        if node.op == "ne":
            return self.put("Not", [self.put("Equal", args)])
        if node.op == "rem":
            return self.put("Mod", args, fmod=1)
        if node.op == "atan":
            return self.arctangent(args)
        if node.op == "finite":
            parts = [self.put("IsInf", args), self.put("IsNaN", args)]
            return self.put("Not", [self.put("Or", parts)])
        if node.op == "int":
            zero = self.numbers(0, node.args[0].kind)
            if node.args[0].kind == "float":
                number = self.put("Where", [self.put("IsNaN", args), zero, *args])
                limits = [self.numbers(limit, "float") for limit in (-(2.0**31), 2.0**31 - 1)]
                args = [self.put("Clip", [number, *limits])]
            return self.put("Cast", args, to=self.tensors["int"])
        if node.op == "idiv":  # nothing divides by zero, also where the result is not used
            a, b = args
            none = self.put("Equal", [b, self.numbers(0)])
            quotient = self.put("Div", [a, self.put("Where", [none, self.numbers(1), b])])
            return self.put("Where", [none, self.numbers(0), quotient])
        return self.put("Cast", args, to=self.tensors[node.op])  # "float" and "bool"

"""Networks as plain data: a list of tensor operations and its tensors, which a file can hold without code.

:func:`torch.export.load` reads files with pickle, which may run code. The form here names operations of PyTorch's core
ATen set only: pure functions of tensors and numbers that neither draw random numbers nor reach files.
"""

from __future__ import annotations

import io
import operator
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from functools import partial
from typing import Any

import torch
from tensordict.nn import set_interaction_type
from torch import Tensor, nn
from torch._subclasses import FakeTensorMode
from torch.distributions import Distribution

from magrl.checks import check_finite, check_type, short

Step = list[Any]
"""Name of an operation, positional arguments, named arguments."""


def _size(operation: Callable[[Any, Any], Any], *sizes: Any) -> Any:
    """Return the result of an operation on sizes; on lists or large numbers it could take any time and memory."""
    large = any(isinstance(size, int) and abs(size) > 2**62 for size in sizes)
    if large or any(isinstance(size, (Tensor, list, tuple, str)) for size in sizes):
        raise ValueError(f"{operation.__name__} takes sizes of batches, got {short(sizes)}")
    return operation(*sizes)


_SIZES = (operator.add, operator.sub, operator.mul, operator.floordiv, operator.mod)
PYTHON = {"getitem": operator.getitem} | {f.__name__: partial(_size, f) for f in _SIZES}
"""Operations on lists of tensors and on sizes of batches."""
RECURRENT = ("lstm.input", "gru.input")
_ACTIVATIONS = ("silu.default", "celu.default", "softplus.default", "mish.default", "log_sigmoid_forward.default")
_FUNCTIONS = ("lerp.Tensor", "lerp.Scalar", "hypot.default", "exp2.default", "addcmul.default", "logaddexp.default")
_REDUCTIONS = ("linalg_vector_norm.default", "std.correction")
_WHOLE = (*RECURRENT, *_ACTIVATIONS, *_FUNCTIONS, *_REDUCTIONS)
WHOLE = {name: getattr(getattr(torch.ops.aten, name.split(".")[0]), name.split(".")[1]) for name in _WHOLE}
"""Operations beside the core set. They are kept whole, because PyTorch rounds their parts otherwise."""
_TRAIN = 6  # argument of recurrent layers that switches on dropout, which is random
TEXTS = ("none", "floor", "trunc", "tanh")
"""Texts that operations may take: modes of a division and of a GELU."""
_LAYOUT = ("layout", "pin_memory", "non_blocking")  # says nothing about values
_TYPES = {"dtype": torch.dtype, "memory_format": torch.memory_format}
MOST_NUMBERS = 10**7
"""Largest total of the numbers that a program computes for one vehicle, beside four times its weights."""
_EXAMPLES = 7  # not one, which PyTorch traces as a special case, and no usual size of a vector


class TensorProgram(nn.Module):
    """A sequence of tensor operations, read from plain data or traced from a module.

    Args:
        num_inputs: number of tensors that it takes.
        steps: operations in their order. The arguments of each are numbers, ``{"value": i}``, ``{"dtype": name}``,
            ``{"memory_format": name}``, ``{"device": None}`` for that of the inputs, and lists of these. Value ``i`` is
            an input, then a tensor, then the result of a step.
        tensors: weights and constants.
        outputs: numbers of the values that are returned.

    Raises:
        ValueError: for anything else, or an operation that is not allowed.
        FloatingPointError: for a tensor that is not finite.

    Example:
        >>> program = TensorProgram(1, [["mul.Tensor", [{"value": 0}, {"value": 1}], {}]], [torch.tensor(2.0)], [2])
        >>> program(torch.ones(3))
        (tensor([2., 2., 2.]),)
    """

    def __init__(
        self, num_inputs: int, steps: Sequence[Step], tensors: Sequence[Tensor], outputs: Sequence[int]
    ) -> None:
        super().__init__()
        check_type(int, num_inputs=num_inputs)
        check_type(list, steps=steps, tensors=tensors, outputs=outputs)
        named = {f"tensor {index}": tensor for index, tensor in enumerate(tensors)}
        check_type(Tensor, **named)
        check_finite(named.items(), "program")
        for index, tensor in enumerate(tensors):
            self.register_buffer(f"tensor_{index}", tensor.detach())
        self.num_inputs, self.steps, self.outputs = num_inputs, list(steps), list(outputs)
        count = num_inputs + len(tensors)
        self._calls = [_call(step, count + number) for number, step in enumerate(steps)]
        if not outputs or not all(isinstance(i, int) and 0 <= i < count + len(steps) for i in outputs):
            raise ValueError(f"outputs must be numbers of values, got {outputs!r}")

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs for inputs of any batch size."""
        values: list[Any] = [*inputs, *self.buffers()]
        for call in self._calls:
            values.append(call(values))
        return tuple(values[index] for index in self.outputs)

    def check_size(self, *inputs: Tensor) -> None:
        """Compute the shapes of all values, without the values, and raise for more than :data:`MOST_NUMBERS`.

        Args:
            inputs: an example of each input, for one vehicle.

        Raises:
            ValueError: naming the operation.
        """
        shapes = FakeTensorMode()
        values: list[Any] = [shapes.from_tensor(value) for value in (*inputs, *self.buffers())]
        most, count = MOST_NUMBERS + 4 * sum(weight.numel() for weight in self.buffers()), 0
        for step, call in zip(self.steps, self._calls, strict=True):
            with shapes:
                values.append(call(values))
            made = values[-1] if isinstance(values[-1], (list, tuple)) else values[-1:]
            count += sum(part.numel() for part in made if isinstance(part, Tensor))
            if count > most:
                raise ValueError(f"{step[0]} makes more numbers than {most}, the most for one vehicle")

    def content(self) -> dict[str, Any]:
        """Return the arguments of the class."""
        tensors = list(self.buffers())
        return {"num_inputs": self.num_inputs, "steps": self.steps, "tensors": tensors, "outputs": self.outputs}


def trace_program(module: nn.Module, inputs: Sequence[Tensor]) -> TensorProgram:
    """Return what a module computes for a batch of any size, without exploration, as a program.

    Args:
        module: module of ``forward(*inputs)`` that returns a tuple of tensors, on the CPU, in evaluation mode.
        inputs: example of each input, ``(N, ...)``.

    Raises:
        ValueError: for a module that PyTorch cannot export, or whose result is random or changes the module.

    Example:
        >>> class Double(nn.Module):
        ...     def forward(self, *inputs):
        ...         return (2 * inputs[0],)
        >>> trace_program(Double(), [torch.zeros(3, 1)])(torch.ones(1, 1))
        (tensor([[2.]]),)
    """
    try:
        table = torch.export.default_decompositions()
        for operation in WHOLE.values():
            table.pop(operation, None)
        exported = _export(module, inputs).run_decompositions(table)
    except Exception as error:  # whatever torch.export and the module raise
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise ValueError(f"PyTorch cannot export it: {reason}") from error
    return _program(exported)


def _export(module: nn.Module, inputs: Sequence[Tensor]) -> torch.export.ExportedProgram:
    """Return a module exported by PyTorch for a batch of any size, without exploration."""
    examples = tuple(value[:1].expand(_EXAMPLES, *value.shape[1:]).clone() for value in inputs)
    batch = torch.export.Dim("batch")
    validated = Distribution._validate_args  # which reads values, and a trace has none
    Distribution.set_default_validate_args(False)
    try:
        # PyTorch prints the graph of what it cannot export, beside the error
        with (
            torch.no_grad(),
            set_interaction_type("deterministic"),
            redirect_stderr(io.StringIO()),
            warnings.catch_warnings(),
        ):
            warnings.filterwarnings("ignore", "The tensor attribute", UserWarning)  # of what a module keeps of its call
            shapes = {"inputs": tuple({0: batch} for _ in examples)}
            return torch.export.export(module, examples, dynamic_shapes=shapes, strict=False)
    finally:
        Distribution.set_default_validate_args(validated)


def _program(exported: torch.export.ExportedProgram) -> TensorProgram:
    """Return the steps of an exported module that its outputs depend on, as plain data."""
    signature = exported.graph_signature
    changed = [*signature.buffers_to_mutate.values(), *signature.user_inputs_to_mutate.values()]
    if changed:
        raise ValueError(f"it changes {', '.join(changed)} as it acts")
    needed = set(signature.user_outputs)
    for node in reversed(exported.graph.nodes):
        if node.name in needed:
            needed.update(source.name for source in node.all_input_nodes)
    sources = {spec.arg.name: spec.target for spec in signature.input_specs if spec.target and spec.arg.name in needed}
    calls = [node for node in exported.graph.nodes if node.name in needed and node.op == "call_function"]
    constant = {node.name: node.target(*node.args, **node.kwargs) for node in calls if _is_constant(node)}
    value = {name: index for index, name in enumerate((*signature.user_inputs, *sources, *constant))}
    steps = []
    for node in calls:
        if node.name not in constant:
            named = {key: _plain(item, value) for key, item in node.kwargs.items() if key not in _LAYOUT}
            steps.append([_name(node.target), _plain(node.args, value), named])
            value[node.name] = len(value)
    stored = exported.state_dict | exported.constants
    tensors = [*(stored[name] for name in sources.values()), *constant.values()]
    outputs = [value[name] for name in signature.user_outputs]
    return TensorProgram(len(signature.user_inputs), steps, tensors, outputs)


def _is_constant(node: torch.fx.Node) -> bool:
    """Return whether a step outside the core set makes the same tensor in every call, such as ``triu_indices``."""
    tags = getattr(node.target, "tags", (torch.Tag.core,))
    return not node.all_input_nodes and not {torch.Tag.core, torch.Tag.nondeterministic_seeded} & set(tags)


def _name(target: Any) -> str:
    return str(target).removeprefix("aten.") if hasattr(target, "overloadpacket") else target.__name__


def _plain(item: Any, value: Mapping[str, int]) -> Any:
    """Return an argument of an exported operation as plain data."""
    if isinstance(item, torch.fx.Node):
        return {"value": value[item.name]}
    if isinstance(item, (list, tuple)):
        return [_plain(part, value) for part in item]
    if isinstance(item, (torch.dtype, torch.memory_format)):
        return {type(item).__name__: str(item).removeprefix("torch.")}
    return {"device": None} if isinstance(item, torch.device) else item


def _call(step: Any, count: int) -> Callable[[Sequence[Any]], Any]:
    """Return a function that computes a step from the values before it.

    Raises:
        ValueError: for anything but an allowed operation with arguments of plain data.
    """
    if not isinstance(step, list) or [type(part) for part in step[1:]] != [list, dict]:
        raise ValueError(f"a step must be a name, arguments and named arguments, got {short(step)}")
    name, args, named = step
    if name in RECURRENT and args[_TRAIN : _TRAIN + 1] != [False]:
        raise ValueError(f"{name} with dropout draws random numbers")
    operation, arguments = _operation(name), _argument(args, count)
    options = {str(key): _argument(item, count) for key, item in named.items()}
    return lambda values: operation(*arguments(values), **{key: item(values) for key, item in options.items()})


def _operation(name: object) -> Callable[..., Any]:
    """Return an operation by name, if it is allowed.

    Raises:
        ValueError: with the name.
    """
    if str(name) in PYTHON | WHOLE:
        return (PYTHON | WHOLE)[str(name)]
    family, _, overload = str(name).partition(".")
    packet = getattr(torch.ops.aten, family, None)
    if not isinstance(packet, torch._ops.OpOverloadPacket) or overload not in packet.overloads():
        raise ValueError(f"{short(name)} is no operation of PyTorch")
    operation: torch._ops.OpOverload = getattr(packet, overload)
    if torch.Tag.nondeterministic_seeded in operation.tags:
        raise ValueError(f"{name} draws random numbers")
    if torch.Tag.core not in operation.tags or operation._schema.is_mutable:
        raise ValueError(f"{name!r} is not one of PyTorch's core operations on tensors")
    return operation


def _argument(item: Any, count: int) -> Callable[[Sequence[Any]], Any]:
    """Return a function from the values before a step to its argument.

    Raises:
        ValueError: for anything but plain data that refers to the ``count`` first values.
    """
    if isinstance(item, list):
        parts = [_argument(part, count) for part in item]
        return lambda values: [part(values) for part in parts]
    if item is None or isinstance(item, (bool, int, float)) or (isinstance(item, str) and item in TEXTS):
        return lambda _: item
    kind, which = next(iter(item.items())) if isinstance(item, dict) and len(item) == 1 else (None, None)
    if kind == "device" and which is None:
        return lambda values: values[0].device
    if kind == "value" and isinstance(which, int) and 0 <= which < count:
        return lambda values: values[which]
    constant = vars(torch).get(which) if isinstance(which, str) else None
    if kind in _TYPES and isinstance(constant, _TYPES[kind]):
        return lambda _: constant
    raise ValueError(f"an argument must be a number, an earlier value or a list of these, got {short(item)}")

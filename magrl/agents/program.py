"""Networks as plain data: a list of tensor operations and its tensors, which a file can hold without code.

:func:`torch.export.load` reads files with pickle, which may run code. The form here names operations of PyTorch's core
ATen set only: pure functions of tensors and numbers that neither draw random numbers nor reach files.
"""

from __future__ import annotations

import io
import operator
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import set_interaction_type
from torch import Tensor, nn
from torch.distributions import Distribution

from magrl.checks import check_finite, check_type, short

Step = list[Any]
"""Name of an operation, positional arguments, named arguments."""
PYTHON = {f.__name__: f for f in (operator.getitem, operator.add, operator.sub, operator.mul, operator.floordiv)}
"""Operations on lists of tensors and on sizes of batches."""
TEXTS = ("none", "floor", "trunc", "tanh")
"""Texts that operations may take: modes of a division and of a GELU."""
_LAYOUT = ("layout", "pin_memory", "non_blocking")  # says nothing about values
_TYPES = {"dtype": torch.dtype, "memory_format": torch.memory_format}
_EXAMPLES = 3  # more than one: PyTorch traces a batch of one as a special case


@dataclass(frozen=True)
class _Reference:
    """An argument that is a value of the program, or for None the device of its inputs."""

    index: int | None


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
        for name, value in {"steps": steps, "tensors": tensors, "outputs": outputs}.items():
            check_type(list, **{name: value})
        for index, tensor in enumerate(tensors):
            check_type(Tensor, **{f"tensor {index}": tensor})
            self.register_buffer(f"tensor_{index}", tensor.detach())
        check_finite(((f"tensor {index}", tensor) for index, tensor in enumerate(tensors)), "program")
        self.num_inputs, self.steps, self.outputs = num_inputs, list(steps), list(outputs)
        known = num_inputs + len(tensors)
        self._operations: list[tuple[Callable[..., Any], Any, Any]] = []
        for number, step in enumerate(steps):
            if not isinstance(step, list) or len(step) != 3 or not isinstance(step[2], dict):
                raise ValueError(f"step {number} must be a name, arguments and named arguments, got {short(step)}")
            name, args, named = step
            check_type(list, **{f"arguments of step {number}": args})
            options = {str(key): _resolved(value, known + number) for key, value in named.items()}
            self._operations.append((_operation(name), _resolved(args, known + number), options))
        if not outputs or not all(isinstance(i, int) and 0 <= i < known + len(steps) for i in outputs):
            raise ValueError(f"outputs must be numbers of values, got {outputs!r}")

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs for inputs of any batch size."""
        values: list[Any] = [*inputs, *self.buffers()]
        for function, args, named in self._operations:
            options = {key: _bound(item, values) for key, item in named.items()}
            values.append(function(*_bound(args, values), **options))
        return tuple(values[index] for index in self.outputs)

    def content(self) -> dict[str, Any]:
        """Return the arguments of the class, with tensors on the CPU."""
        tensors = [tensor.cpu().clone() for tensor in self.buffers()]
        return {"num_inputs": self.num_inputs, "steps": self.steps, "tensors": tensors, "outputs": self.outputs}


def trace_program(module: nn.Module, inputs: Sequence[Tensor]) -> TensorProgram:
    """Return what a module computes for a batch of any size, without exploration, as a program.

    Args:
        module: module that takes tensors and returns a tuple of tensors, on the CPU, in evaluation mode.
        inputs: example of each input, ``(N, ...)``.

    Raises:
        ValueError: for a module that PyTorch cannot export, or whose result is random or changes the module.

    Example:
        >>> class Double(nn.Module):
        ...     def forward(self, x):
        ...         return (2 * x,)
        >>> trace_program(Double(), [torch.zeros(3, 1)])(torch.ones(1, 1))
        (tensor([[2.]]),)
    """
    try:
        exported = export_module(module, inputs).run_decompositions()
    except Exception as error:  # whatever torch.export and the module raise
        raise ValueError(f"PyTorch cannot export it: {_first_line(error)}") from error
    return _program(exported)


def export_module(module: nn.Module, inputs: Sequence[Tensor]) -> torch.export.ExportedProgram:
    """Return a module exported by PyTorch for a batch of any size, without exploration.

    Args:
        module: module that takes tensors and returns a tuple of tensors, on the CPU, in evaluation mode.
        inputs: example of each input, ``(N, ...)``.

    Example:
        >>> program = TensorProgram(1, [["neg.default", [{"value": 0}], {}]], [], [1])
        >>> export_module(program, [torch.zeros(3, 1)]).module()(torch.ones(2, 1))
        (tensor([[-1.],
                [-1.]]),)
    """
    check_type(nn.Module, module=module)
    examples = tuple(value[:1].expand(_EXAMPLES, *value.shape[1:]).clone() for value in inputs)
    batch = torch.export.Dim("batch")
    validated = Distribution._validate_args  # which reads values, and a trace has none
    Distribution.set_default_validate_args(False)
    try:
        # PyTorch prints the graph of what it cannot export, beside the error
        with torch.no_grad(), set_interaction_type("deterministic"), redirect_stderr(io.StringIO()):
            shapes = {"inputs": tuple({0: batch} for _ in examples)}
            return torch.export.export(_Inputs(module), examples, dynamic_shapes=shapes, strict=False)
    finally:
        Distribution.set_default_validate_args(validated)


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0] or type(error).__name__


class _Inputs(nn.Module):
    """A module under the one signature that names its inputs."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        return self.module(*inputs)


def _program(exported: torch.export.ExportedProgram) -> TensorProgram:
    """Return the steps of an exported module that its outputs depend on, as plain data."""
    signature = exported.graph_signature
    changed = [*signature.buffers_to_mutate.values(), *signature.user_inputs_to_mutate.values()]
    if changed:
        raise ValueError(f"it changes {', '.join(changed)} as it acts")
    nodes = {node.name: node for node in exported.graph.nodes}
    held = exported.state_dict | exported.constants
    names = {
        **signature.inputs_to_parameters,
        **signature.inputs_to_buffers,
        **signature.inputs_to_lifted_tensor_constants,
    }
    needed: set[str] = set()
    waiting = [nodes[name] for name in signature.user_outputs]
    while waiting:
        node = waiting.pop()
        if node.name not in needed:
            needed.add(node.name)
            waiting += node.all_input_nodes
    order = [*signature.user_inputs, *(name for name in names if name in needed)]
    tensors = [held[names[name]].detach() for name in order if name in names]
    value = {name: index for index, name in enumerate(order)}
    steps = []
    for node in exported.graph.nodes:
        if node.name in needed and node.op == "call_function":
            named = {key: _plain(item, value) for key, item in node.kwargs.items() if key not in _LAYOUT}
            steps.append([_name(node.target), _plain(node.args, value), named])
            value[node.name] = len(value)
    return TensorProgram(len(signature.user_inputs), steps, tensors, [value[name] for name in signature.user_outputs])


def _name(target: Any) -> str:
    return str(target).removeprefix("aten.") if hasattr(target, "overloadpacket") else target.__name__


def _operation(name: object) -> Callable[..., Any]:
    """Return an operation by name, if it is allowed.

    Raises:
        ValueError: with the name.
    """
    if isinstance(name, str) and name in PYTHON:
        return PYTHON[name]
    family, _, overload = name.partition(".") if isinstance(name, str) else ("", "", "")
    packet = getattr(torch.ops.aten, family, None) if family else None
    if not isinstance(packet, torch._ops.OpOverloadPacket) or overload not in packet.overloads():
        raise ValueError(f"{short(name)} is no operation of PyTorch")
    found: torch._ops.OpOverload = getattr(packet, overload)
    if torch.Tag.nondeterministic_seeded in found.tags:
        raise ValueError(f"{name} draws random numbers")
    if torch.Tag.core not in found.tags or found._schema.is_mutable:
        raise ValueError(f"{name!r} is not one of PyTorch's core operations on tensors")
    return found


def _plain(item: Any, value: Mapping[str, int]) -> Any:
    """Return an argument of an exported operation as plain data."""
    if isinstance(item, torch.fx.Node):
        return {"value": value[item.name]}
    if isinstance(item, (list, tuple)):
        return [_plain(part, value) for part in item]
    if isinstance(item, (torch.dtype, torch.memory_format)):
        return {type(item).__name__: str(item).removeprefix("torch.")}
    return {"device": None} if isinstance(item, torch.device) else item


def _resolved(item: Any, known: int) -> Any:
    """Return an argument of a step with references in place of their texts.

    Raises:
        ValueError: for anything but plain data that refers to values before the step.
    """
    if isinstance(item, list):
        return [_resolved(part, known) for part in item]
    if item is None or isinstance(item, (bool, int, float)) or (isinstance(item, str) and item in TEXTS):
        return item
    kind, which = next(iter(item.items())) if isinstance(item, dict) and len(item) == 1 else (None, None)
    if kind == "device" and which is None:
        return _Reference(None)
    if kind == "value" and isinstance(which, int) and 0 <= which < known:
        return _Reference(which)
    found = vars(torch).get(which) if isinstance(which, str) else None
    if kind in _TYPES and isinstance(found, _TYPES[kind]):
        return found
    raise ValueError(f"an argument must be a number, a known value or a list of these, got {short(item)}")


def _bound(item: Any, values: Sequence[Any]) -> Any:
    """Return an argument with values in place of references."""
    if isinstance(item, list):
        return [_bound(part, values) for part in item]
    if isinstance(item, _Reference):
        return values[0].device if item.index is None else values[item.index]
    return item

"""Networks of any algorithm and library as ONNX files, which onnxruntime runs (extra ``onnx``)."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib import import_module
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, set_interaction_type
from torch import Tensor, nn
from torch.distributions import Distribution

from magrl.checks import short

DESCRIPTION = "magrl"
"""Entry of the metadata of a file that describes its policy, as JSON."""
FORMAT = 1
TOLERANCE = 1e-4
"""Largest difference of an exported action in [-1, 1]: float32 operations in another order."""
_CHECKED = 5  # observations on which a network is checked


class OnnxNetwork(nn.Module):
    """A network of an ONNX file as an actor: from ``observation`` ``(..., K)`` to ``action`` in [-1, 1].

    The file has the input ``observation`` ``(N, K)`` and the output ``action`` ``(N, 2)``, or ``(N, 3)`` for a policy
    that declares its arrival; beyond [-1, 1] it is cut off. A network with a memory has more inputs, of any names and
    shapes ``(N, ...)``, and for each input ``NAME`` an output ``next_NAME``. They are 0 where an episode starts.

    Args:
        content: content of the file.
        size: numbers K of an observation.

    Raises:
        ImportError: without the extra ``onnx``.
        ValueError: for a file with other inputs or outputs, that does not run, or whose action is not finite.
    """

    def __init__(self, content: bytes, size: int) -> None:
        super().__init__()
        self.content, self.size = content, size
        self.register_buffer("file", torch.frombuffer(bytearray(content), dtype=torch.uint8))
        session = _session(content)
        inputs = {each.name: each for each in session.get_inputs()}
        outputs = [each.name for each in session.get_outputs()]
        memory = [name for name in inputs if name != "observation"]
        self.after = tuple(f"next_{name}" for name in memory)
        if "observation" not in inputs or set(outputs) != {"action", *self.after}:
            raise ValueError(
                "it must take 'observation' and the memory, and return 'action' and 'next_NAME' for each NAME of the "
                f"memory (input_names, output_names of torch.onnx.export), got {[*inputs]} and {outputs}"
            )
        for name, each in inputs.items():
            _check_input(each, [size] if name == "observation" else each.shape[1:])
        self.shapes = {name: tuple(inputs[name].shape[1:]) for name in memory}
        action, *after = self.run(torch.zeros(_CHECKED, size), {key: torch.zeros(1) for key in self.shapes})
        if action.shape not in [(_CHECKED, 2), (_CHECKED, 3)] or not action.isfinite().all():
            raise ValueError(f"'action' must be finite, (N, 2) or (N, 3), got {short(action.tolist())}")
        if (found := [tuple(part.shape[1:]) for part in after]) != [*self.shapes.values()]:
            raise ValueError(f"the memory must keep its shapes {[*self.shapes.values()]}, the outputs have {found}")
        self.action_size = action.shape[-1]

    def run(self, observation: Tensor, memory: Mapping[str, Tensor]) -> list[Tensor]:
        """Return the action in [-1, 1] and the next memory for observations ``(N, K)``."""
        values = {key: memory[key].expand(len(observation), *shape) for key, shape in self.shapes.items()}
        values["observation"] = observation
        feed = {key: value.detach().cpu().float().numpy() for key, value in values.items()}
        found = _session(self.content).run(["action", *self.after], feed)
        action, *after = (torch.from_numpy(part).to(observation.device) for part in found)
        return [action.clamp(-1, 1), *after]


def with_description(content: bytes, description: Mapping[str, Any]) -> bytes:
    """Return an ONNX file whose metadata describe its policy, without PyTorch's metadata on where it was exported."""
    onnx = _library("onnx")
    model = onnx.load_model_from_string(content)
    for part in (model.graph, *model.functions):
        _strip(part)
    entries = {entry.key: entry.value for entry in model.metadata_props}
    onnx.helper.set_model_props(model, entries | {DESCRIPTION: json.dumps({"format": FORMAT, **description})})
    return model.SerializeToString()


def _strip(part: Any) -> None:
    """Remove metadata and comments from a part of a model and all parts in it: they hold paths of a machine."""
    for field, value in part.ListFields():
        if field.name in ("metadata_props", "doc_string"):
            part.ClearField(field.name)
        elif field.message_type:
            for each in [value] if hasattr(value, "ListFields") else value:
                _strip(each)


def description_of(content: bytes) -> dict[str, Any]:
    """Return the description of a policy in the metadata of an ONNX file.

    Raises:
        ValueError: for a file without one, or of another format.
    """
    found = dict(json.loads(_session(content).get_modelmeta().custom_metadata_map.get(DESCRIPTION, "{}")))
    if (version := found.pop("format", None)) != FORMAT:
        message = f"its metadata have {DESCRIPTION!r} of format {short(version)}; this version reads format {FORMAT}"
        raise ValueError(f"{message}: state what the network observes by save_policy('policy.onnx', FILE, view)")
    return found


def has_view(content: bytes) -> bool:
    """Return whether an ONNX file says what its policy observes; if not, the network takes ``observation`` as it is."""
    return '"kind"' in _session(content).get_modelmeta().custom_metadata_map.get(DESCRIPTION, "")


def exported(actor: nn.Module, size: int, memory: Mapping[str, Sequence[int]]) -> OnnxNetwork:
    """Return a network as ONNX, compared with the original on random observations; the original stays as it is.

    Args:
        actor: module from ``observation`` ``(N, size)`` and the tensors of its memory to the action, or a tuple of the
            action and the next memory; or a TensorDict module that reads these as keys and writes ``action`` and
            ``("next", key)``, whose deterministic sample is taken.
        size: numbers of an observation.
        memory: shapes of the memory without its batch, by name.

    Raises:
        ImportError: without the extra ``onnx``.
        ValueError: for a network that PyTorch cannot export, or whose export acts differently.
    """
    _library("onnxscript")
    draw = torch.Generator().manual_seed(0)
    inputs = [2 * torch.rand(_CHECKED, *shape, generator=draw) - 1 for shape in ((size,), *memory.values())]
    modes, validated = {part: part.training for part in actor.modules()}, Distribution._validate_args
    Distribution.set_default_validate_args(False)  # validation reads values, which a trace has not
    try:
        with torch.no_grad(), set_interaction_type("deterministic"), warnings.catch_warnings(action="ignore"):
            step = _Step(actor, memory).eval()
            wanted, content = step(*inputs), _written(step, inputs, memory)
    except Exception as error:  # whatever the module and PyTorch raise
        reason = str(error.__cause__ or error).strip().partition("\n")[0]
        raise ValueError(f"PyTorch cannot export it: {reason or type(error).__name__}") from error
    finally:
        Distribution.set_default_validate_args(validated)
        for part, mode in modes.items():
            part.training = mode
    network = OnnxNetwork(content, size)
    _compare(network, inputs, [wanted[0].clamp(-1, 1), *wanted[1:]])
    return network


class _Step(nn.Module):
    """One step of an actor over plain tensors."""

    def __init__(self, actor: nn.Module, memory: Mapping[str, Sequence[int]]) -> None:
        super().__init__()
        self.actor, self.keys = actor, ("observation", *memory)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        if not isinstance(self.actor, TensorDictModuleBase):
            found = self.actor(*inputs)
            return (found,) if isinstance(found, Tensor) else tuple(found)
        acted = self.actor(TensorDict(dict(zip(self.keys, inputs, strict=True)), inputs[0].shape[:1]))
        return acted["action"], *(acted["next", key] for key in self.keys[1:])


def _written(step: _Step, inputs: Sequence[Tensor], memory: Mapping[str, Sequence[int]]) -> bytes:
    """Return a step as ONNX, for a batch of any size."""
    names = {"input_names": ["observation", *memory], "output_names": ["action", *(f"next_{key}" for key in memory)]}
    options: dict[str, Any] = {"dynamic_shapes": {"inputs": tuple({0: torch.export.Dim("N")} for _ in inputs)}, **names}
    program: Any = torch.onnx.export(step, tuple(inputs), dynamo=True, verbose=False, **options)
    return program.model_proto.SerializeToString()


def _compare(network: OnnxNetwork, inputs: Sequence[Tensor], wanted: Sequence[Tensor]) -> None:
    """Raise unless a network acts like another one, on one observation at a time."""
    for row in range(_CHECKED):
        observation, *memory = (part[row : row + 1] for part in inputs)
        found = network.run(observation, dict(zip(network.shapes, memory, strict=True)))
        difference = max(float((a - b[row]).abs().max()) for a, b in zip(found, wanted, strict=True))
        if not difference <= TOLERANCE:
            raise ValueError(
                f"its export acts differently, by {difference:g}: each row of the outputs must depend on the same row "
                "of the inputs alone, without branches on values and without a state that is no input"
            )


def _check_input(found: Any, shape: Sequence[int]) -> None:
    """Raise unless an input has a shape after its batch, which must be of any size, and a type of real numbers."""
    batch, *rest = found.shape or [None]
    sized = all(isinstance(part, int) for part in rest)
    if not isinstance(batch, str) or not sized or list(shape) != rest or found.type != "tensor(float)":
        raise ValueError(
            f"{found.name!r} must be float32 (N, {', '.join(map(str, shape))}) for any N (dynamic_axes or "
            f"dynamic_shapes of torch.onnx.export), got {found.type} {found.shape}"
        )


@lru_cache(maxsize=8)
def _session(content: bytes) -> Any:
    """Return the session of a file; outside of the modules, which are copied."""
    runtime = _library("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = torch.get_num_threads(), 4
    return runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(f"policies as ONNX need the package {name}: pip install 'magrl[onnx]'") from error

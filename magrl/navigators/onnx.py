"""Networks of any algorithm and library as ONNX files, which onnxruntime runs (extra ``onnx``)."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, set_interaction_type
from torch import Tensor, nn
from torch.distributions import Distribution

from magrl.checks import check_float32, library, short

DESCRIPTION = "magrl"
"""Entry of the metadata of a file that describes its policy, as JSON."""
FORMAT = 2
TOLERANCE = 1e-4
"""Largest difference of an exported action in [-1, 1]: float32 operations in another order."""
_CHECKED = 5  # observations on which a network is checked


class OnnxNetwork(nn.Module):
    """A network of an ONNX file as an actor: from ``observation`` ``(N, K)`` to ``action`` in [-1, 1].

    The file has the input ``observation`` ``(N, K)`` and the output ``action`` ``(N, 2)``, or ``(N, 3)`` for a policy
    that declares its arrival; beyond [-1, 1] it is cut off.

    Args:
        content: content of the file.
        size: numbers K of an observation.

    Raises:
        ImportError: without the extra ``onnx``.
        ValueError: for a file with other inputs or outputs, that does not run, that has numbers in another file or
            loops, or whose action is not finite or depends on other rows.
    """

    def __init__(self, content: bytes, size: int) -> None:
        super().__init__()
        self.content, self.size = content, size
        self.register_buffer("file", torch.frombuffer(bytearray(content), dtype=torch.uint8))
        session = _session(content)
        inputs, outputs = session.get_inputs(), [each.name for each in session.get_outputs()]
        if [each.name for each in inputs] != ["observation"] or outputs != ["action"]:
            raise ValueError(
                "it must take 'observation' and return 'action' (input_names, output_names of torch.onnx.export), got "
                f"{[each.name for each in inputs]} and {outputs}"
            )
        _check_input(inputs[0], size)
        action = self(observation := _observation(size))
        if action.shape not in [(_CHECKED, 2), (_CHECKED, 3)] or not action.isfinite().all():
            raise ValueError(f"'action' must be finite, (N, 2) or (N, 3), got {short(action.tolist())}")
        _compare(self, observation, action)
        self.action_size = action.shape[-1]

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action in [-1, 1] for observations ``(N, K)``."""
        feed = {"observation": observation.detach().cpu().float().numpy()}
        (action,) = _session(self.content).run(["action"], feed)
        return torch.from_numpy(action).to(observation.device).clamp(-1, 1)


def with_description(content: bytes, description: Mapping[str, Any]) -> bytes:
    """Return an ONNX file whose metadata describe its policy, without others, which hold paths of a machine."""
    onnx = library("onnx", "onnx")
    model = onnx.load_model_from_string(content)
    for part in [part for root in (model.graph, *model.functions) for part in _parts(root)]:
        for name in {"metadata_props", "doc_string"} & {*part.DESCRIPTOR.fields_by_name}:
            part.ClearField(name)
    entries = {entry.key: entry.value for entry in model.metadata_props}
    onnx.helper.set_model_props(model, entries | {DESCRIPTION: json.dumps({"format": FORMAT, **description})})
    return model.SerializeToString()


def _parts(part: Any) -> Iterator[Any]:
    """Yield a part of a model and all parts in it."""
    yield part
    for field, value in part.ListFields():
        if field.message_type:
            for each in [value] if hasattr(value, "ListFields") else value:
                yield from _parts(each)


def _check_parts(content: bytes) -> None:
    """Raise for a network that reads another file, or may never end."""
    for part in _parts(library("onnx", "onnx").load_model_from_string(content)):
        if getattr(part, "external_data", ()):
            raise ValueError(f"{part.name!r} is in another file: write all into one (save_as_external_data=False)")
        if getattr(part, "op_type", "") == "Loop":
            raise ValueError("it must be a network without Loop, which may never end")


def description_of(content: bytes) -> dict[str, Any]:
    """Return the description of a policy in the metadata of an ONNX file.

    Raises:
        ValueError: for a file without one, or of another format.
    """
    if not has_view(content):
        remedy = "score it with magrl.score, or save it with what it observes by save_policy('policy.onnx', FILE, view)"
        raise ValueError(f"it is a bare network: {remedy}")
    found = dict(json.loads(_session(content).get_modelmeta().custom_metadata_map.get(DESCRIPTION, "{}")))
    if (version := found.pop("format", None)) != FORMAT:
        message = f"its metadata have {DESCRIPTION!r} of format {short(version)}; this version reads format {FORMAT}"
        raise ValueError(f"{message}: state what the network observes by save_policy('policy.onnx', FILE, view)")
    return found


def has_view(content: bytes) -> bool:
    """Return whether an ONNX file says what its policy observes; if not, the network takes ``observation`` as it is."""
    return '"kind"' in _session(content).get_modelmeta().custom_metadata_map.get(DESCRIPTION, "")


def exported(actor: nn.Module, size: int) -> OnnxNetwork:
    """Return a network as ONNX, compared with the original on random observations; the original stays as it is.

    Args:
        actor: module from ``observation`` ``(N, size)`` to the action; or a TensorDict module with these keys, whose
            deterministic sample is taken.
        size: numbers of an observation.

    Raises:
        ImportError: without the extra ``onnx``.
        TypeError: for weights of another type than float32.
        ValueError: for a network that PyTorch cannot export, or whose export acts differently.
    """
    library("onnxscript", "onnx")
    check_float32(actor, "actor")
    observation = _observation(size)
    modes, validated = {part: part.training for part in actor.modules()}, Distribution._validate_args
    Distribution.set_default_validate_args(False)  # validation reads values, which a trace has not
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)  # no lines on torchvision
    try:
        with torch.no_grad(), set_interaction_type("deterministic"), warnings.catch_warnings(action="ignore"):
            step = _Step(actor).eval()
            wanted, content = step(observation), _written(step, observation)
    except Exception as error:  # whatever the module and PyTorch raise
        reason = str(error.__cause__ or error).strip().partition("\n")[0]
        remedy = ": give the module that was scripted" if isinstance(actor, torch.jit.ScriptModule) else ""
        raise ValueError(f"PyTorch cannot export it: {reason or type(error).__name__}{remedy}") from error
    finally:
        log.setLevel(level)
        Distribution.set_default_validate_args(validated)
        for part, mode in modes.items():
            part.training = mode
    network = OnnxNetwork(content, size)
    _compare(network, observation, wanted.clamp(-1, 1))
    return network


def _observation(size: int) -> Tensor:
    """Return random observations in [-1, 1], without a change of the global random numbers."""
    draw = torch.Generator().manual_seed(0)
    return 2 * torch.rand(_CHECKED, size, generator=draw, dtype=torch.float32) - 1


class _Step(nn.Module):
    """One step of an actor over plain tensors."""

    def __init__(self, actor: nn.Module) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, observation: Tensor) -> Tensor:
        if not isinstance(self.actor, TensorDictModuleBase):
            return self.actor(observation)
        return self.actor(TensorDict({"observation": observation}, observation.shape[:1]))["action"]


def _written(step: _Step, observation: Tensor) -> bytes:
    """Return a step as ONNX, for a batch of any size."""
    options: dict[str, Any] = {"input_names": ["observation"], "output_names": ["action"]}
    options["dynamic_shapes"] = {"observation": {0: torch.export.Dim("N")}}
    program: Any = torch.onnx.export(step, (observation,), dynamo=True, verbose=False, **options)
    return program.model_proto.SerializeToString()


def _compare(network: OnnxNetwork, observation: Tensor, wanted: Tensor) -> None:
    """Raise unless a network acts like another one, on one observation at a time."""
    for row in range(_CHECKED):
        difference = float((network(observation[row : row + 1]) - wanted[row]).abs().max())
        if not difference <= TOLERANCE:
            raise ValueError(
                f"a row alone acts differently, by {difference:g}: each row of the outputs must depend on the same row "
                "of the inputs alone, without branches on values and without a state that is no input"
            )


def _check_input(found: Any, size: int) -> None:
    """Raise unless an input is ``(N, size)`` for any N, of real numbers."""
    batch, *rest = found.shape or [None]
    if not isinstance(batch, str) or rest != [size] or found.type != "tensor(float)":
        raise ValueError(
            f"{found.name!r} must be float32 (N, {size}) for any N (dynamic_axes or "
            f"dynamic_shapes of torch.onnx.export), got {found.type} {found.shape}"
        )


@lru_cache(maxsize=8)
def _session(content: bytes) -> Any:
    """Return the session of a file; outside of the modules, which are copied."""
    _check_parts(content)
    runtime = library("onnxruntime", "onnx")
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = torch.get_num_threads(), 4
    return runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])

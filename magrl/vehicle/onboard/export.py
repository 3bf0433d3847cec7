"""The step of a pilot as one function of tensors, in files for vehicles without magrl and TorchRL."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from magrl.sensor_std import SensorStd
from magrl.tracking import Reading, Rules, State, act, blank, pilot

_FLOAT32 = 1  # number of the type in ONNX
INPUTS = ("field", "target", "distance", "heading", "std", "step", *State._fields)
"""Names of the tensors that a step takes: see :meth:`PilotStep.forward`."""
OUTPUTS = ("action", "way", "way_covariance", "probability", *(f"next_{name}" for name in State._fields))
"""Names of the tensors that it returns."""


class PilotStep(nn.Module):
    """One step of :mod:`magrl.tracking.pilot` from plain tensors to plain tensors, with the correction of the noise and
    the declaration of the arrival.

    Args:
        rules: rules of the vehicle; its arrival is declared.
        network: correction of the plan; None for that of ``"kalman"``.

    Example:
        >>> module = PilotStep(Rules())
        >>> action, way, covariance, probability, *state = module(*first_inputs().values())
        >>> action.shape
        torch.Size([3])
    """

    def __init__(self, rules: Rules, network: nn.Module | None = None) -> None:
        super().__init__()
        self.rules, self.network = rules.replace(arrival="declared"), network

    def forward(
        self,
        field: Tensor,
        target: Tensor,
        distance: Tensor,
        heading: Tensor,
        std: Tensor,
        step: Tensor,
        *state: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return what to do after a move, the estimates, and the next state.

        Args:
            field: ``(3,)`` reading of D [deg], I [deg], B_H [nT] after the move.
            target: ``(3,)`` the same at the destination.
            distance: ``()`` of the move [km]; 0 in the first step.
            heading: ``()`` of it [rad].
            std: ``(4, 3)`` standard deviations of noise, bias, drift and iron
                (:class:`~magrl.sensor_std.SensorStd`), float64; a noise of 1e4 for an element that was not read.
            step: ``()`` int64, number of the step from 0 on.
            state: parts of :class:`~magrl.tracking.State`; any in the first step.

        Returns:
            Distance [km], turn [rad] and, positive where the vehicle has arrived, the declaration ``(3,)``; the way to
            the destination northward and eastward ``(2,)`` [km], its covariance ``(2, 2)`` [km^2], the probability of
            having arrived, and the parts of the next state.
        """
        reading = Reading(field, target, distance, heading, SensorStd(*std), step)
        track = pilot.step(self.rules, State(*state), reading)
        action, decision = act(self.rules, track, reading, self.network)
        assert decision is not None
        return action, *track.way, decision.probability, *track.state


def first_inputs() -> dict[str, Tensor]:
    """Return inputs of the first step, by name: with any reading, and sensors without errors.

    Example:
        >>> list(first_inputs())[:3]
        ['field', 'target', 'distance']
    """
    here, zero = torch.tensor([3.5, 73.0, 15000.0]), torch.tensor(0.0)
    reading = Reading(here, here, zero, zero, SensorStd(*torch.zeros(4, 3, dtype=torch.float64)), torch.tensor(0))
    inputs = (*reading[:4], torch.stack([*reading.std]), reading.step, *blank(reading))
    # An export takes the same tensor for the same input
    return dict(zip(INPUTS, (value.clone() for value in inputs), strict=True))


def write_step(path: Path | str, rules: Rules, network: nn.Module | None = None) -> None:
    """Write the step of a pilot as a file that runs without magrl and TorchRL.

    :func:`torch.export.load` reads a file ``.pt2``; its module takes and returns the tensors of :class:`PilotStep`.
    PyTorch reads such a file with pickle: load it only from a source that you trust. A file ``.onnx`` runs without
    PyTorch; its inputs and outputs are named :data:`INPUTS` and :data:`OUTPUTS`.

    Args:
        path: path of the file, ``.pt2`` or ``.onnx``.
        rules: those of :func:`~magrl.tracking.load_pilot`, with other values where the vehicle needs them.
        network: from the same function; None for ``"kalman"``.

    Raises:
        ValueError: for another suffix.
        ImportError: for ``.onnx`` without the extra ``onnx``.
        OSError: if the file cannot be written.

    Example:
        >>> write_step("kalman.pt", Rules())
        Traceback (most recent call last):
        ValueError: a file of a step must end with .pt2 or .onnx, got 'kalman.pt'
    """
    if Path(path).suffix not in (".pt2", ".onnx"):
        raise ValueError(f"a file of a step must end with .pt2 or .onnx, got {str(path)!r}")
    module, inputs = PilotStep(rules, network).cpu().eval(), first_inputs()
    inputs["std"][1, 0] = math.inf  # no true north: the constants of this are needed, too
    with torch.no_grad():
        module(*inputs.values())  # computes the constants of the model, which are no part of the step
        exported = torch.export.export(module, tuple(inputs.values()), strict=False)
    if Path(path).suffix == ".onnx":
        content = _onnx(exported)
    else:
        file = io.BytesIO()
        torch.export.save(exported, file)
        content = file.getvalue()
    Path(path).write_bytes(content)


def _onnx(exported: torch.export.ExportedProgram) -> bytes:
    """Return an exported step as ONNX, which lacks ``hypot``; its runtime lacks tangents of float64."""
    try:
        from onnxscript import opset18
    except ImportError as error:
        raise ImportError("ONNX needs the package onnxscript: pip install 'magrl[onnx]'") from error
    ops: Any = opset18

    def hypot(x: Any, y: Any) -> Any:
        return ops.Sqrt(ops.Add(ops.Mul(x, x), ops.Mul(y, y)))

    def atan2(y: Any, x: Any) -> Any:
        north, east = ops.Cast(x, to=_FLOAT32), ops.Cast(y, to=_FLOAT32)
        nowhere = ops.And(ops.Equal(north, 0.0), ops.Equal(east, 0.0))
        ahead = ops.Atan(ops.Div(east, ops.Where(nowhere, 1.0, north)))
        half_turn = ops.Where(ops.Less(east, 0.0), -math.pi, math.pi)
        behind = ops.Less(north, 0.0)
        return ops.CastLike(ops.Where(behind, ops.Add(ahead, half_turn), ahead), x)

    def tan(x: Any) -> Any:
        return ops.Div(ops.Sin(x), ops.Cos(x))

    aten = torch.ops.aten
    translations = {torch.ops.prims.hypot.default: hypot, aten.atan2.default: atan2, aten.tan.default: tan}
    options: dict[str, Any] = {"input_names": INPUTS, "output_names": OUTPUTS, "dynamo": True}
    options |= {"custom_translation_table": translations, "verbose": False}
    program: Any = torch.onnx.export(exported, **options)
    for value in (value for node in program.model.graph for value in node.outputs):
        if value.name in INPUTS:  # an operation may have the name of an input
            value.name = f"{value.name}_value"
    return program.model_proto.SerializeToString()

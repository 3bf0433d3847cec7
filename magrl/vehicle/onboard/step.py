"""The step of an agent without a map as one function of tensors, for vehicles without TorchRL."""

from __future__ import annotations

import copy
import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from magrl import tracking
from magrl.agents.policy import FieldPolicy
from magrl.checks import check_tensor, check_type
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import Belief
from magrl.tracking.belief import STATES
from magrl.transforms import TrackView
from magrl.transforms.track import BELIEF_KEYS, TRACK_KEYS, tracked

_FLOAT32 = 1  # number of the type in ONNX
ONNX_INPUTS = ("field", "target_field", "course", "accuracy", "step", *BELIEF_KEYS, "first_field")
"""Names of the tensors that a step takes, in ONNX: see :meth:`VehicleStep.forward`."""
ONNX_OUTPUTS = ("action", "way", "way_covariance", *(f"next_{name}" for name in ONNX_INPUTS[4:]))
"""Names of the tensors that it returns."""


class StepState(NamedTuple):
    """Hold the state of an agent between its steps; :func:`first_state` is that before the first one.

    Example:
        >>> StepState._fields
        ('step', 'belief_mean', 'belief_covariance', 'belief_latitude', 'first_field')
    """

    step: Tensor
    belief_mean: Tensor
    belief_covariance: Tensor
    belief_latitude: Tensor
    first_field: Tensor


def first_state() -> StepState:
    """Return the state before the first step.

    Example:
        >>> first_state().belief_covariance.shape
        torch.Size([25, 25])
    """
    eye = torch.eye(STATES, dtype=torch.float64)
    field = torch.tensor([20000.0, 0.0, 40000.0], dtype=torch.float64)  # any, but a possible one
    mean = torch.cat((field, torch.zeros_like(eye[0, 3:])))
    return StepState(torch.tensor(0), mean, eye, torch.zeros_like(eye[0, :1]), torch.zeros(3))


class VehicleStep(nn.Module):
    """One step of an agent that reads its own track, from plain tensors to plain tensors, without a batch.

    It does not search (:class:`~magrl.transforms.SearchAim`), because nobody confirms an arrival to the vehicle.

    Args:
        policy: trained policy with a :class:`~magrl.transforms.TrackView`.

    Raises:
        ValueError: for a policy that observes something else.

    Example:
        >>> from magrl.agents import load_pretrained
        >>> act = VehicleStep(load_pretrained("anywhere"))
        >>> here, there, exact = torch.tensor([3.5, 73, 15000]), torch.tensor([-11.6, 75.4, 13240]), torch.zeros(4, 3)
        >>> action, way, covariance, *state = act(here, there, torch.zeros(2), exact, *first_state())
        >>> action.shape, state[0]
        (torch.Size([2]), tensor(1))
    """

    def __init__(self, policy: FieldPolicy) -> None:
        super().__init__()
        check_type(FieldPolicy, policy=policy)
        view = policy.config.view
        if not isinstance(view, TrackView):
            raise ValueError(f"the policy must read its own track (TrackView), got {view}")
        self.view = replace(view, search=False)
        alone = FieldPolicy(replace(policy.config, view=self.view), policy.actor)
        self.observe, self.act, self.actor = alone.observe_tracked, alone.act, alone.actor

    def forward(
        self,
        field: Tensor,
        target_field: Tensor,
        course: Tensor,
        accuracy: Tensor,
        step: Tensor,
        belief_mean: Tensor,
        belief_covariance: Tensor,
        belief_latitude: Tensor,
        first_field: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return what to do after a move, the estimates, and the next state.

        Args:
            field: ``(3,)`` reading of D [deg], I [deg], B_H [nT] after the move.
            target_field: ``(3,)`` the same at the destination.
            course: ``(2,)`` distance [km] and heading [rad] of the move; in the first step 0 and the heading.
            accuracy: ``(4, 3)`` standard deviations of noise, bias, drift and iron
                (:class:`~magrl.sensor_std.SensorStd`).
            step: ``()`` int64, and with the next four the :class:`StepState`.
            belief_mean: ``(25,)`` mean of the belief, float64.
            belief_covariance: ``(25, 25)`` its covariance, float64.
            belief_latitude: ``(1,)`` its reference latitude, float64.
            first_field: ``(3,)`` first reading.

        Returns:
            Distance [km] and turn [rad] ``(2,)``, the way to the destination northward and eastward ``(2,)`` [km],
            its covariance ``(2, 2)`` [km^2], and the parts of the next state.
        """
        check_tensor(4, 3, accuracy=accuracy)
        (distance, heading), errors = course, SensorStd(*accuracy)
        crust_nt = self.view.crust_nt
        begun = tracking.start(field, errors, heading, crust_nt)
        before = Belief(belief_mean, belief_covariance, belief_latitude[0])
        after = tracking.read(tracking.moved(before, distance, heading, errors), field, errors.noise, heading, crust_nt)
        starts = step == 0
        belief = Belief(*(torch.where(starts, new, old) for new, old in zip(begun, after, strict=True)))
        now = dict(zip(TRACK_KEYS, tracked(belief, target_field, self.view.range_km, crust_nt), strict=True))
        now |= dict(zip(STD_KEYS, errors, strict=True)) | {"field": field, "target_field": target_field}
        now |= {"heading": heading.reshape(1), "elapsed_steps": step.reshape(1)}
        first = {"first_field": torch.where(starts, field, first_field).unsqueeze(0)}
        batch = TensorDict({key: value.unsqueeze(0) for key, value in now.items()}, [1])
        observed = self.observe(TensorDict(first, [1]).set("next", batch))["next"]
        action = self.act.denormalize("action", self.actor(observed)["action"])
        state = (observed[key][0] for key in (*BELIEF_KEYS, "first_field"))
        return action[0], observed["way"][0], observed["way_covariance"][0], step + 1, *state


def write_step(path: Path | str, policy: FieldPolicy) -> None:
    """Write the step of an agent that reads its own track as a file that runs without magrl and TorchRL.

    :func:`torch.export.load` reads a file ``.pt2``; its module takes and returns the tensors of :class:`VehicleStep`.
    PyTorch reads such a file with pickle: load it only from a source that you trust. A file ``.onnx`` runs without
    PyTorch; its inputs and outputs are named :data:`ONNX_INPUTS` and :data:`ONNX_OUTPUTS`.

    Args:
        path: path of the file, ``.pt2`` or ``.onnx``.
        policy: trained policy, such as ``load_pretrained("anywhere")``.

    Raises:
        ValueError: for another suffix, or a policy that does not read its own track.
        ImportError: for ``.onnx`` without the extra ``onnx``.
        OSError: if the file cannot be written.

    Example:
        >>> from magrl.agents import load_pretrained
        >>> write_step("anywhere.pt", load_pretrained("anywhere"))
        Traceback (most recent call last):
        ValueError: a file of a step must end with .pt2 or .onnx, got 'anywhere.pt'
    """
    if Path(path).suffix not in (".pt2", ".onnx"):
        raise ValueError(f"a file of a step must end with .pt2 or .onnx, got {str(path)!r}")
    module = VehicleStep(copy.deepcopy(policy).cpu()).eval()
    accuracy = torch.zeros(4, 3)
    accuracy[1, 0] = math.inf  # no true north: the constants of this are needed, too
    examples = torch.ones(3), torch.ones(3), torch.zeros(2), accuracy
    with torch.no_grad():
        module(*examples, *first_state())  # computes the constants of the model, which are no part of the step
        exported = torch.export.export(module, (*examples, *first_state()), strict=False)
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
    options: dict[str, Any] = {"input_names": ONNX_INPUTS, "output_names": ONNX_OUTPUTS, "dynamo": True}
    options |= {"custom_translation_table": translations, "verbose": False}
    program: Any = torch.onnx.export(exported, **options)
    return program.model_proto.SerializeToString()

"""Networks of agents: a deterministic actor and a critic, as TensorDict modules."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, TanhModule, ValueOperator

from magrl.checks import check_number, check_type
from magrl.geodesy import steer
from magrl.tracking import corrected
from magrl.transforms import TrackView

Device = torch.device | str | None
MOST_LAYERS = 64
"""Largest number of hidden layers."""


def make_mlp(inputs: int, outputs: int, num_cells: Sequence[int], *, layer_norm: bool, device: Device = None) -> MLP:
    """Return a perceptron with ReLU and, if ``layer_norm``, layer normalization after each hidden layer.

    Args:
        inputs: size of the input.
        outputs: size of the output.
        num_cells: width of each hidden layer.
        layer_norm: whether hidden layers are normalized.
        device: device of the parameters.

    Raises:
        ValueError: for a size that is not a whole number from 1 to 65536.

    Example:
        >>> make_mlp(13, 2, (32, 32), layer_norm=True)(torch.zeros(5, 13)).shape
        torch.Size([5, 2])
    """
    check_number(1, 65536, whole=True, inputs=inputs, outputs=outputs)
    check_type(Sequence, num_cells=num_cells)
    check_number(1, MOST_LAYERS, whole=True, hidden_layers=len(num_cells))
    for width in num_cells:
        check_number(1, 65536, whole=True, num_cells=width)
    norm = {"norm_class": nn.LayerNorm, "norm_kwargs": [{"normalized_shape": width} for width in num_cells]}
    network = MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=list(num_cells),
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},  # the layer before it does not need its output to differentiate
        device=device,
        **(norm if layer_norm else {}),
    )
    for index in (0, len(network) - 1):
        network[index] = Float32Linear(network[index])
    return network


class Float32Linear(nn.Linear):
    """A linear layer that keeps float32 where the layers around it are cast to bfloat16 (``torch.autocast``).

    bfloat16 has three significant digits. In the first layer they would round off small differences of the observed
    elements, in the last the differences between the values of actions.

    Args:
        layer: layer whose parameters it takes over.

    Example:
        >>> layer = Float32Linear(nn.Linear(4, 2))
        >>> with torch.autocast("cpu", dtype=torch.bfloat16):
        ...     layer(torch.zeros(5, 4, dtype=torch.bfloat16)).dtype
        torch.float32
    """

    def __init__(self, layer: nn.Linear) -> None:
        super().__init__(layer.in_features, layer.out_features, device="meta")
        self.weight, self.bias = layer.weight, layer.bias

    def forward(self, input: Tensor) -> Tensor:
        """Return the output of the layer, as ``nn.Linear``."""
        kind = input.device.type
        if not torch.is_autocast_enabled(kind):
            return super().forward(input)
        with torch.autocast(kind, enabled=False):
            return super().forward(input.float())


def make_actor(
    observation_size: int, num_cells: Sequence[int], *, layer_norm: bool = True, device: Device = None
) -> TensorDictSequential:
    """Return a deterministic actor: ``observation`` ``(..., K)`` to ``logits`` and ``action`` ``(..., 2)``.

    The action is the tanh of the logits. The output bias starts at zero: half the longest move, no turn.

    Args:
        observation_size: number of entries K of the observation.
        num_cells: width of each hidden layer.
        layer_norm: whether hidden layers are normalized.
        device: device of the parameters.

    Raises:
        ValueError: for a size that is not a whole number from 1 to 65536.

    Example:
        >>> from tensordict import TensorDict
        >>> obs = TensorDict(observation=torch.zeros(5, 13), batch_size=[5])
        >>> make_actor(13, (32, 32))(obs)["action"].shape
        torch.Size([5, 2])
    """
    network = make_mlp(observation_size, 2, num_cells, layer_norm=layer_norm, device=device)
    bias = nn.init.zeros_(network[-1].bias)
    squash = TanhModule(in_keys=["logits"], out_keys=["action"]).to(bias.device)
    return TensorDictSequential(TensorDictModule(network, ["observation"], ["logits"]), squash)


class CorrectedMove(nn.Module):
    """The action of a plan and its correction, scaled to [-1, 1]; see :func:`magrl.tracking.corrected`.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].

    Example:
        >>> CorrectedMove(50.0, 1.5)(torch.tensor([25.0, 0.0]), torch.zeros(1))
        tensor([0., 0.])
    """

    def __init__(self, max_move_km: float, max_turn_rad: float) -> None:
        super().__init__()
        self.limits = float(max_move_km), float(max_turn_rad)

    def forward(self, planned: Tensor, heading: Tensor, correction: Tensor | None = None) -> Tensor:
        """Return the scaled action ``(..., 2)`` of a displacement northward and eastward [km] at a heading
        ``(..., 1)`` [rad], and its correction."""
        move = planned if correction is None else corrected(planned, correction)
        north, east = move.unbind(-1)
        bearing, distance = torch.atan2(east, north), torch.hypot(north, east)
        distance, turn = steer(heading.squeeze(-1), bearing, distance, *self.limits)
        return torch.stack((2 * distance / self.limits[0] - 1, turn / self.limits[1]), -1)


def make_correcting_actor(
    view: TrackView, num_cells: Sequence[int] | None, *, device: Device = None
) -> TensorDictSequential:
    """Return an actor that corrects a plan: ``observation`` and ``planned_move`` to ``correction`` and ``action``.

    Its correction starts at zero, so that the untrained actor flies as planned.

    Args:
        view: what it observes.
        num_cells: width of each hidden layer; None for an actor without a network, which flies as planned.
        device: device of the parameters.

    Raises:
        ValueError: for a size that is not a whole number from 1 to 65536.

    Example:
        >>> from magrl.transforms import TrackView
        >>> view = TrackView(zeta=0.01, max_steps=50, max_move_km=50.0, max_turn_rad=1.5)
        >>> make_correcting_actor(view, (32, 32)).out_keys
        ['correction', 'action']
    """
    move, keys = CorrectedMove(view.max_move_km, view.max_turn_rad), ["planned_move", "heading"]
    if num_cells is None:
        return TensorDictSequential(TensorDictModule(move, keys, ["action"]))
    network = make_mlp(view.size, 2, num_cells, layer_norm=True, device=device)
    for parameter in network[-1].parameters():
        nn.init.zeros_(parameter)
    return TensorDictSequential(
        TensorDictModule(network, ["observation"], ["correction"]),
        TensorDictModule(move, [*keys, "correction"], ["action"]),
    )


def make_critic(
    observation_size: int,
    num_cells: Sequence[int],
    *,
    layer_norm: bool = True,
    device: Device = None,
) -> ValueOperator:
    """Return a critic: ``observation`` ``(..., K)`` and ``action`` ``(..., 2)`` to ``state_action_value`` ``(..., 1)``.

    Args:
        observation_size: number of entries K of the observation.
        num_cells: width of each hidden layer.
        layer_norm: whether hidden layers are normalized.
        device: device of the parameters.

    Raises:
        ValueError: for a size that is not a whole number from 1 to 65536.

    Example:
        >>> from tensordict import TensorDict
        >>> batch = TensorDict(observation=torch.zeros(5, 13), action=torch.zeros(5, 2), batch_size=[5])
        >>> make_critic(13, (32, 32))(batch)["state_action_value"].shape
        torch.Size([5, 1])
    """
    network = make_mlp(observation_size + 2, 1, num_cells, layer_norm=layer_norm, device=device)
    return ValueOperator(network, in_keys=["observation", "action"])

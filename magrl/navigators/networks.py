"""Networks of agents: a deterministic actor and a critic, as TensorDict modules."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, TanhModule, ValueOperator

from magrl.checks import check_number, check_type
from magrl.pilot import Rules
from magrl.pilot.planning import corrected
from magrl.pilot.step import moving
from magrl.transforms.areas import RADIUS_KM, SEEN, SIGHT_KM
from magrl.transforms.views import ObservationView

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
    return MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=list(num_cells),
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},  # the layer before it does not need its output to differentiate
        device=device,
        **(norm if layer_norm else {}),
    )


class Geometry(nn.Module):
    """A fixed first layer without weights for observations of one region.

    It adds the differences to the destination in the frame of the heading, also over their size, and its logarithm, if
    both are observed. Of each no-go area in sight (:class:`~magrl.transforms.NoGoAreas`) it adds the direction, the
    distance of the center, and the bearings of the center and of both edges; with an action, also by how much the leg
    clears each of them. A perceptron learns such products and angles slowly, and the edges decide about a collision.

    The input is an observation, perhaps with an action ``(..., 2)`` in [-1, 1].

    Args:
        view: columns of the observation and limits of the action.

    Example:
        >>> from magrl.named_tasks import no_go_env
        >>> geometry = Geometry(no_go_env(seed=0).view)
        >>> geometry(torch.zeros(5, 25)).shape, geometry(torch.zeros(5, 27)).shape
        (torch.Size([5, 62]), torch.Size([5, 72]))
    """

    UNIT_KM, CLEAR_KM, LEAST = 100.0, 20.0, 0.01

    def __init__(self, view: ObservationView) -> None:
        super().__init__()
        self.view = view

    def forward(self, observed: Tensor) -> Tensor:
        """Return the input with its features."""
        columns, (seen, action) = self.view.columns, observed.tensor_split([self.view.size], -1)
        parts = [seen]
        if {"difference", "heading"} <= columns.keys():
            difference, heading = (seen[..., columns[name]] for name in ("difference", "heading"))
            size = difference.norm(dim=-1, keepdim=True) + self.LEAST
            turned = (difference.unsqueeze(-1) * heading.unsqueeze(-2)).flatten(-2)
            parts += [turned, turned / size, size.log()]
        if "areas" in columns:
            parts += self._of_areas(seen[..., columns["areas"]], action)
        return torch.cat((*parts, action), -1)

    def _of_areas(self, areas: Tensor, action: Tensor) -> list[Tensor]:
        """Return the features of areas, and those of an action if there is one."""
        areas = areas.unflatten(-1, (SEEN, 3))
        ahead, right, size = areas.unbind(-1)
        there, near = size > 0, torch.sqrt(ahead.square() + right.square() + 1e-12)
        radius = RADIUS_KM[1] * size
        center = radius + SIGHT_KM * (1 - near)
        bearing = torch.atan2(right, ahead + 1e-9)
        half = torch.asin((radius / center.clamp_min(1.0)).clamp(0, 1))
        edges = torch.stack((half, bearing - half, bearing + half), -1) * (2 / math.pi)
        unit = areas[..., :2] / near.clamp_min(1e-4).unsqueeze(-1)
        about = torch.cat((unit, center.unsqueeze(-1) / self.UNIT_KM, edges), -1) * there.unsqueeze(-1)
        if not action.shape[-1]:
            return [about.flatten(-2)]
        clear_km = self._clear_km(action, center, bearing) - radius
        clear = (clear_km / self.CLEAR_KM).clamp(-1.5, 3.0).where(there, 3.0)
        return [about.flatten(-2), clear, torch.sigmoid(clear_km / 2).where(there, 1.0)]

    def _clear_km(self, action: Tensor, center: Tensor, bearing: Tensor) -> Tensor:
        """Return the least distance of a leg from centers ``(..., 4)`` [km]."""
        leg = self.view.max_leg_km / 2 * (action[..., :1] + 1)
        away = bearing - action[..., 1:] * self.view.max_turn_rad
        along, across = center * torch.cos(away), center * torch.sin(away)
        return torch.hypot(along - torch.minimum(along.clamp_min(0), leg), across)


def make_network(
    inputs: int,
    outputs: int,
    num_cells: Sequence[int],
    *,
    layer_norm: bool,
    geometry: ObservationView | None = None,
    device: Device = None,
) -> nn.Sequential:
    """Return a perceptron, perhaps behind :class:`Geometry`; other arguments as of :func:`make_mlp`.

    Example:
        >>> make_network(24, 1, (8,), layer_norm=True)(torch.zeros(5, 24)).shape
        torch.Size([5, 1])
    """
    first = [] if geometry is None else [Geometry(geometry)]
    size = nn.Sequential(*first)(torch.zeros(inputs)).shape[-1]
    network = make_mlp(size, outputs, num_cells, layer_norm=layer_norm, device=device)
    return nn.Sequential(*first, *network) if geometry else network


def make_actor(
    observation_size: int,
    num_cells: Sequence[int],
    *,
    layer_norm: bool = True,
    geometry: ObservationView | None = None,
    device: Device = None,
) -> TensorDictSequential:
    """Return a deterministic actor: ``observation`` ``(..., K)`` to ``logits`` and ``action`` ``(..., 2)``.

    The action is the tanh of the logits. The output bias starts at zero: half the longest leg, no turn.

    Args:
        observation_size: number of entries K of the observation.
        num_cells: width of each hidden layer.
        layer_norm: whether hidden layers are normalized.
        geometry: view of the observation that :class:`Geometry` reads as the first layer, or None.
        device: device of the parameters.

    Raises:
        ValueError: for a size that is not a whole number from 1 to 65536.

    Example:
        >>> from tensordict import TensorDict
        >>> obs = TensorDict(observation=torch.zeros(5, 13), batch_size=[5])
        >>> make_actor(13, (32, 32))(obs)["action"].shape
        torch.Size([5, 2])
    """
    network = make_network(observation_size, 2, num_cells, layer_norm=layer_norm, geometry=geometry, device=device)
    last: Any = network[-1]
    bias = nn.init.zeros_(last.bias)
    squash = TanhModule(in_keys=["logits"], out_keys=["action"]).to(bias.device)
    return TensorDictSequential(TensorDictModule(network, ["observation"], ["logits"]), squash)


class CorrectedLeg(nn.Module):
    """The action of a plan and its correction, scaled to [-1, 1]; see :func:`magrl.pilot.planning.corrected`.

    Args:
        rules: limits of the leg.

    Example:
        >>> CorrectedLeg(Rules())(torch.tensor([25.0, 0.0]), torch.zeros(1), torch.zeros(2))
        tensor([0., 0.])
    """

    def __init__(self, rules: Rules) -> None:
        super().__init__()
        self.rules = rules

    def forward(self, planned: Tensor, heading: Tensor, correction: Tensor) -> Tensor:
        """Return the scaled action ``(..., 2)`` of a displacement northward and eastward [km] at a heading
        ``(..., 1)`` [rad], and its correction."""
        distance, turn = moving(self.rules, corrected(planned, correction), heading.squeeze(-1)).unbind(-1)
        return torch.stack((2 * distance / self.rules.max_leg_km - 1, turn / self.rules.max_turn_rad), -1)


def make_correcting_actor(network: nn.Module, rules: Rules) -> TensorDictSequential:
    """Return an actor that corrects the plan of a :class:`~magrl.transforms.TrackField`: to ``correction`` and
    ``action``, scaled to [-1, 1].

    Args:
        network: from ``observation`` to a correction (:func:`magrl.pilot.network.correction_network`).
        rules: limits of the leg.

    Example:
        >>> from magrl.pilot.network import correction_network
        >>> make_correcting_actor(correction_network((32, 32)), Rules()).out_keys
        ['correction', 'action']
    """
    keys = [("track", "plan"), "heading", "correction"]
    return TensorDictSequential(
        TensorDictModule(network, ["observation"], ["correction"]),
        TensorDictModule(CorrectedLeg(rules), keys, ["action"]),
    )


class Spread(nn.Module):
    """The standard deviation of corrections, the same for all: a buffer that a training sets.

    Example:
        >>> Spread(0.3)(torch.zeros(2))[1]
        tensor([0.3000, 0.3000])
    """

    std: Tensor

    def __init__(self, std: float) -> None:
        super().__init__()
        self.register_buffer("std", torch.tensor(std))

    def forward(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation."""
        return mean, self.std.expand_as(mean)


def make_drawn_correction(mean: TensorDictModuleBase, spread: Spread) -> ProbabilisticActor:
    """Return the policy of PPO: normal corrections, to ``correction`` and ``correction_log_prob``.

    Args:
        mean: module that writes ``mean``.
        spread: their standard deviation.

    Example:
        >>> mean = TensorDictModule(nn.Linear(3, 2), ["observation"], ["mean"])
        >>> make_drawn_correction(mean, Spread(0.3)).in_keys
        ['observation']
    """
    return ProbabilisticActor(
        TensorDictSequential(mean, TensorDictModule(spread, ["mean"], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        out_keys=["correction"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"tanh_loc": False},
        return_log_prob=True,
    )


def make_critic(
    observation_size: int,
    num_cells: Sequence[int],
    *,
    layer_norm: bool = True,
    geometry: ObservationView | None = None,
    device: Device = None,
) -> ValueOperator:
    """Return a critic: ``observation`` ``(..., K)`` and ``action`` ``(..., 2)`` to ``state_action_value`` ``(..., 1)``.

    Args:
        observation_size: number of entries K of the observation.
        num_cells: width of each hidden layer.
        layer_norm: whether hidden layers are normalized.
        geometry: view of the observation that :class:`Geometry` reads as the first layer, or None.
        device: device of the parameters.

    Raises:
        ValueError: for a size that is not a whole number from 1 to 65536.

    Example:
        >>> from tensordict import TensorDict
        >>> batch = TensorDict(observation=torch.zeros(5, 13), action=torch.zeros(5, 2), batch_size=[5])
        >>> make_critic(13, (32, 32))(batch)["state_action_value"].shape
        torch.Size([5, 1])
    """
    network = make_network(observation_size + 2, 1, num_cells, layer_norm=layer_norm, geometry=geometry, device=device)
    return ValueOperator(network, in_keys=["observation", "action"])

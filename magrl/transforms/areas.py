"""No-go areas: discs that a vehicle sees only from nearby, and that end its episode."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.data import Bounded, Composite
from torchrl.envs import Transform

from magrl.checks import check_number
from magrl.geodesy import move_place, polar, steer
from magrl.random_numbers import stream_uniform
from magrl.transforms.base import observed_spec, with_state
from magrl.transforms.episode import Episode, EpisodeNumbers

ALONG, ACROSS_KM = (0.2, 0.8), 80.0
"""Centers lie at this share of the displacement from the destination to the start, and up to so far beside it [km]."""
NUMBER, SEEN = 4, 4
"""Discs of an episode by default, and those that are observed at once, nearest first."""
RADIUS_KM, SIGHT_KM = (15.0, 40.0), 75.0
"""Lowest and highest radius, and the distance from the edge within which a disc is seen [km]; chosen."""
CLEAR_KM, DEGREES = 0.3, 180
"""By how much a shielded leg clears areas in sight [km], chosen among 0, 0.3 and 1; turns tried to each side."""


class NoGoAreas(EpisodeNumbers):
    """Draw discs between start and destination for each episode, which ends without success in a leg that meets one.

    A vehicle that steers straight at its destination must fail in some episodes, however well it knows the direction.
    Place this before the reward, which reads the success. Distances are those in the plane around the destination.
    A radius is at most two thirds of the distance from a center to either end of a trip.

    Args:
        number: discs of an episode.
        **options: ``in_keys``, ``out_keys`` and ``seed`` of :class:`~magrl.transforms.episode.EpisodeNumbers`. The
            keys read are the true displacement ``(..., 2)`` in the frame of the vehicle [km], heading ``(..., 1)``
            [rad], and the flags ``success``, ``terminated``, ``truncated`` and ``done`` ``(..., 1)``, which are also
            written. ``areas`` ``(..., 12)`` has for each disc in sight 1 at its edge to 0 at the limit of sight,
            times the direction forward and to the right, and its radius as a share of the highest. The key
            ``no_go_areas`` is the state: north and east of the center from the destination and radius of each disc
            [km], then the vehicle's position. It is privileged.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import TrueDisplacement
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), Compose(TrueDisplacement(), NoGoAreas()))
        >>> env.rollout(3)["areas"].shape
        torch.Size([2, 3, 12])
    """

    channel = 11
    numbers_key, stream_key = "no_go_areas", "no_go_stream"
    default_in_keys = ("true_displacement", "heading", "success", "terminated", "truncated", "done")
    default_out_keys = ("areas",)

    def __init__(self, number: int = NUMBER, **options: Any) -> None:
        super().__init__(**options)
        check_number(1, 100, whole=True, number=number)
        self.number, self.size = number, 3 * number + 2

    @staticmethod
    def discs(numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Return centers ``(..., number, 2)``, north and east of the destination, and radii ``(..., number)`` [km]."""
        discs = numbers[..., :-2].unflatten(-1, (-1, 3))
        return discs[..., :2], discs[..., 2]

    def _constants(self, stream: Tensor) -> Tensor:
        return stream_uniform(stream, self.size)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        displacement, heading, *flags = values
        place, numbers = -turned(displacement, heading), episode.numbers
        if episode.first:
            numbers = self._placed(numbers, place)
        centers, radii = self.discs(numbers)
        met = (distance_km(centers, numbers[..., -2:], place) < radii).any(-1, keepdim=True)
        success, terminated, truncated, done = flags
        after = (success & ~met, terminated | met, truncated & ~met, done | met)
        for key, flag in zip(self.in_keys[2:], after, strict=True):
            tensordict.set(key, flag)
        tensordict.set(self.out_keys[0], self._seen(centers - place.unsqueeze(-2), radii, heading))
        return torch.cat((numbers[..., :-2], place), -1)

    def _placed(self, uniform: Tensor, start: Tensor) -> Tensor:
        """Return the discs of an episode that begins at ``start`` ``(..., 2)`` [km], and that place."""
        share, across, radius = uniform[..., :-2].unflatten(-1, (self.number, 3)).unbind(-1)
        low, high = ALONG
        along, beside = (low + (high - low) * share).unsqueeze(-1), ACROSS_KM * (2 * across - 1).unsqueeze(-1)
        right = torch.stack((-start[..., 1], start[..., 0]), -1) / start.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        centers = along * start.unsqueeze(-2) + beside * right.unsqueeze(-2)
        radii = RADIUS_KM[0] + (RADIUS_KM[1] - RADIUS_KM[0]) * radius
        ends_km = torch.minimum(centers.norm(dim=-1), (centers - start.unsqueeze(-2)).norm(dim=-1))
        radii = torch.minimum(radii, 2 / 3 * ends_km)  # both ends of a short trip are free
        return torch.cat((torch.cat((centers, radii.unsqueeze(-1)), -1).flatten(-2), start), -1)

    def _seen(self, relative: Tensor, radii: Tensor, heading: Tensor) -> Tensor:
        """Return what is observed of discs at ``relative`` ``(..., number, 2)`` from the vehicle."""
        distance = relative.norm(dim=-1)
        gap_km, nearest = (distance - radii).topk(min(SEEN, radii.shape[-1]), largest=False)
        ahead = turned(relative, -heading.unsqueeze(-2)) / distance.clamp_min(1e-6).unsqueeze(-1)
        ahead = ahead.take_along_dim(nearest.unsqueeze(-1), -2)
        closeness = (1 - gap_km.clamp_min(0) / SIGHT_KM).clamp_min(0).unsqueeze(-1)
        size = (radii.gather(-1, nearest) / RADIUS_KM[1]).unsqueeze(-1) * (closeness > 0)
        seen = torch.cat((closeness * ahead, size), -1).flatten(-2).clamp(-1, 1)
        return pad(seen, (0, 3 * SEEN - seen.shape[-1]))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add what is observed, in [-1, 1], and the state."""
        observation_spec = super().transform_observation_spec(observation_spec)
        like = observation_spec[self.in_keys[0]]
        shape = (*like.shape[:-1], 3 * SEEN)
        observation_spec[self.out_keys[0]] = Bounded(-1.0, 1.0, shape, device=like.device, dtype=like.dtype)
        return observation_spec


class Shield(Transform):
    """Turn legs that would meet an area in sight, as :func:`shielded`, in an environment with :class:`NoGoAreas`.

    It reads the ``areas`` before a step, and the action in km and rad: place it before the scaling of actions. The
    action of the policy stays in the data. It has neither weights nor state.

    Args:
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for a largest turn out of range.
        KeyError: for a step from a TensorDict without areas.

    Example:
        >>> from magrl.named_tasks import no_go_env
        >>> no_go_env(4, seed=0, transforms=[Shield()]).rollout(3)["observation"].shape
        torch.Size([4, 3, 25])
    """

    def __init__(self, max_turn_rad: float = math.pi / 2) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        check_number(0, math.pi, above=True, max_turn_rad=max_turn_rad)
        self.max_turn_rad = max_turn_rad

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if (action := tensordict.get("action", None)) is None:
            return tensordict
        if (areas := tensordict.get("areas", None)) is None:
            raise KeyError("Shield reads 'areas', which no_go_env has: step from what reset() or step_mdp() returned")
        return tensordict.set("action", shielded(action, areas, self.max_turn_rad))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Make the areas part of the state, for environments in other processes."""
        areas = observed_spec(self).get("areas", None)
        return input_spec if areas is None else with_state(input_spec, {"areas": areas})


def shielded(action: Tensor, areas: Tensor, max_turn_rad: float = math.pi / 2) -> Tensor:
    """Turn legs that would come within :data:`CLEAR_KM` of an area in sight by the least angle that clears it.

    Where that angle is beyond the largest turn, the vehicle turns as far as it can and stays. Where none clears the
    areas, it takes the one that enters least. Other legs stay as they are.

    Args:
        action: ``(..., K)``, distance [km] and turn [rad] first.
        areas: ``(..., 12)`` what is seen before the leg (:class:`NoGoAreas`).
        max_turn_rad: largest turn [rad].

    Returns:
        The action ``(..., K)``.

    Example:
        >>> ahead = torch.tensor([0.5, 0.0, 0.5] + 9 * [0.0])  # a radius of 20 km, from 37.5 km on
        >>> shielded(torch.tensor([[50.0, 0.0], [30.0, 0.0]]), ahead.expand(2, -1))
        tensor([[50.0000, -0.3665],
                [30.0000,  0.0000]])
    """
    meets = inside_km(areas, action[..., :1], action[..., 1:2]).squeeze(-1) > 0
    length, turn = action[meets][..., :2].split(1, -1)
    offset = torch.arange(-DEGREES, DEGREES + 1, device=turn.device).to(turn.dtype) * (math.pi / 180)
    cost = inside_km(areas[meets], length, turn + offset) + offset.abs() / 100  # a clear leg, and then the least turn
    chosen = turn + offset[cost.argmin(-1, keepdim=True)]
    turned_leg = steer(torch.zeros_like(chosen), chosen, length, math.inf, max_turn_rad)
    action = action.clone()
    action[meets] = torch.cat((*turned_leg, action[meets][..., 2:]), -1)
    return action


def inside_km(areas: Tensor, length: Tensor, angle: Tensor, beside_km: float = CLEAR_KM) -> Tensor:
    """Return how far legs enter areas in sight and a strip beside them.

    Args:
        areas: ``(..., 12)`` what is seen before the leg (:class:`NoGoAreas`).
        length: ``(..., 1)`` of the legs [km].
        angle: ``(..., A)`` turn before each leg [rad].
        beside_km: width of the strip [km].

    Returns:
        ``(..., A)`` [km], 0 for legs that meet none.
    """
    ahead, right, size = (part.unsqueeze(-2) for part in areas.unflatten(-1, (SEEN, 3)).unbind(-1))
    radius = RADIUS_KM[1] * size
    center_km = radius + SIGHT_KM * (1 - torch.hypot(ahead, right))
    away = torch.atan2(right, ahead) - angle.unsqueeze(-1)
    along, across = center_km * torch.cos(away), center_km * torch.sin(away)
    nearest = torch.hypot(along - torch.minimum(along.clamp_min(0), length.unsqueeze(-1)), across)
    return ((radius + beside_km - nearest).clamp_min(0) * (size > 0)).amax(-1)


def outlines(numbers: Tensor, target: Tensor, points: int = 61) -> Tensor:
    """Return the outlines of the discs of an episode on the map.

    Args:
        numbers: ``(..., 14)`` the state ``no_go_areas``.
        target: ``(..., 2)`` latitude, longitude of the destination [deg].
        points: number of points of each.

    Returns:
        ``(..., number, points, 2)`` latitude, longitude [deg].

    Example:
        >>> outlines(torch.zeros(5, 14), torch.zeros(5, 2)).shape
        torch.Size([5, 4, 61, 2])
    """
    centers, radii = NoGoAreas.discs(numbers)
    angle = torch.linspace(0, 2 * math.pi, points, device=numbers.device)
    ring = radii[..., None, None] * torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    distance, bearing = polar(centers.unsqueeze(-2) + ring)
    return move_place(target[..., None, None, :].expand(*distance.shape, 2), bearing, distance)


def turned(vector: Tensor, angle: Tensor) -> Tensor:
    """Return vectors ``(..., 2)``, forward and right, turned by headings ``(..., 1)`` [rad]: north and east."""
    (x, y), (cosine, sine) = vector.unbind(-1), (f(angle.squeeze(-1)) for f in (torch.cos, torch.sin))
    return torch.stack((cosine * x - sine * y, sine * x + cosine * y), -1)


def distance_km(point: Tensor, begin: Tensor, end: Tensor) -> Tensor:
    """Return the distance of points ``(..., K, 2)`` from the segment between two others ``(..., 2)``: ``(..., K)``."""
    leg, offset = (end - begin).unsqueeze(-2), point - begin.unsqueeze(-2)
    share = (offset * leg).sum(-1, keepdim=True) / leg.square().sum(-1, keepdim=True).clamp_min(1e-9)
    return (offset - share.clamp(0, 1) * leg).norm(dim=-1)

"""TensorDict specs of the navigation environment, each for one vehicle."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from magrl.checks import check_tensor, require
from magrl.envs.regions import Regions
from magrl.field import FieldBank, FieldModel, elements_at
from magrl.transforms.errors.base import DISPLACEMENT, EPISODE_STREAM

REWARD_TERMS = ("reward_destination", "reward_proximity")
"""Privileged keys of the terms whose sum is ``reward``; 0 at a reset."""
DECLARED = "declared"
"""Flag that the vehicle has declared its arrival, where it must."""
CONSTANT_KEYS = ("target_field", "target_position", "start_position", "objective_weights", "region", EPISODE_STREAM)
"""Keys that keep their values throughout an episode."""
STATE_KEYS = (*CONSTANT_KEYS, "heading", "elapsed_steps", "position", "objective", DISPLACEMENT)
"""Keys that a step reads: the state of an episode."""


_NORTH_EAST = torch.tensor((90.0, 180.0), dtype=torch.float64)
POSITION = Bounded(-_NORTH_EAST, _NORTH_EAST, dtype=torch.float64)
"""Spec of a latitude and a longitude [deg]."""
FLAG = Binary(1, dtype=torch.bool)
"""Spec of a flag."""


def field_bounds(field: FieldModel | FieldBank, boxes: Regions) -> tuple[Tensor, Tensor]:
    """Return bounds of the elements over every place in boxes, from a grid and 5 % of slack.

    Args:
        field: field model, or a bank of them, on the device of the boxes.
        boxes: every place that a vehicle can reach, in each region.

    Returns:
        Lowest and highest D [deg], I [deg], B_H [nT], ``(3,)`` each.

    Raises:
        ValueError: for a field that is not defined on all of a box, or whose declination is not continuous there.

    Example:
        >>> from magrl.envs import Region
        >>> from magrl.field import IGRF
        >>> low, high = field_bounds(IGRF("2022-01-01"), Regions.of(Region((-10, 0), (160, 170))))
        >>> [round(bound) for bound in high.tolist()]
        [11, -8, 35670]
    """
    values = region_elements(field, boxes, points=81 if len(boxes) == 1 else 11)
    lowest, highest = values.amin(1), values.amax(1)
    undefined, turning = ~torch.isfinite(lowest + highest).all(-1), highest[:, 0] - lowest[:, 0] > 180
    if undefined.any():
        raise ValueError(
            f"the field is not defined on all of {boxes[int(undefined.nonzero()[0])]}, which a vehicle can reach: take "
            "a field of a larger box, or a smaller region, margin_deg or max_move_km"
        )
    if turning.any():
        raise ValueError(
            f"the declination turns through south in {boxes[int(turning.nonzero()[0])]}: D jumps from 180 to -180 "
            "degrees there; take a region farther from the magnetic pole"
        )
    low, high = lowest.amin(0), highest.amax(0)
    slack = 0.05 * (high - low)
    limit = torch.tensor((180.0, 90.0, math.inf), dtype=torch.float64, device=values.device)
    return (low - slack).maximum(-limit), (high + slack).minimum(limit)


def region_elements(field: FieldModel | FieldBank, regions: Regions, points: int) -> Tensor:
    """Return the elements on an even grid of each region: ``(K, points², 3)``, D [deg], I [deg], B_H [nT]."""
    index = torch.arange(len(regions), device=regions.latitude.device)
    return elements_at(field, regions.grid(points).flatten(1, 2), index.unsqueeze(-1))


def observation_spec(
    field_bounds: tuple[Tensor, Tensor],
    max_move_km: float,
    max_turn_rad: float,
    num_regions: int = 1,
    declared: bool = False,
    drift_km: float = 0.0,
) -> Composite:
    """Return the spec of what a vehicle observes after a step, privileged keys included.

    Args:
        field_bounds: lowest and highest D [deg], I [deg], B_H [nT], ``(3,)`` each.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        num_regions: number of regions.
        declared: whether there is the flag ``declared``.
        drift_km: how much farther than its command errors of motion may carry a vehicle [km]; above 0, there is the key
            ``displacement``.

    Example:
        >>> observation_spec((torch.zeros(3), torch.ones(3)), 50.0, 1.5).expand(4)["field"].shape
        torch.Size([4, 3])
    """
    field, number = float_bounds(*field_bounds), Unbounded((1,), dtype=torch.float32)
    highest_move = torch.tensor((max_move_km, max_turn_rad), dtype=torch.float32)
    more = {DECLARED: FLAG} if declared else {}
    reach = 2 * max_move_km + drift_km  # from the end of a commanded move to that of a true one
    more |= {DISPLACEMENT: Bounded(-reach, reach, (2,), dtype=torch.float64)} if drift_km else {}
    return Composite(
        field=field,
        target_field=field.clone(),
        move=float_bounds(highest_move * torch.tensor((0, -1)), highest_move),
        heading=Bounded(-math.pi, math.pi, (1,), dtype=torch.float32),
        elapsed_steps=Unbounded((1,), dtype=torch.int64),
        position=POSITION.clone(),
        target_position=POSITION.clone(),
        start_position=POSITION.clone(),
        objective=number,
        objective_weights=number.expand(3),
        success=FLAG.clone(),
        region=Bounded(0, num_regions - 1, (1,), dtype=torch.int64),
        episode_stream=Unbounded((1,), dtype=torch.int64),
        **{term: number.clone() for term in REWARD_TERMS},
        **more,
    )


def float_bounds(low: Tensor, high: Tensor) -> Bounded:
    """Return the spec of bounded float32 numbers, whatever torch's default type is.

    Example:
        >>> float_bounds(torch.zeros(2, dtype=torch.float64), torch.ones(2)).dtype
        torch.float32
    """
    return Bounded(low.cpu().float(), high.cpu().float(), dtype=torch.float32)


def checked_action(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return actions in float64, rounded into their bounds.

    Args:
        action: ``(N, 2)`` distance [km], turn [rad]; ``(N, 3)`` where an arrival is declared.
        low: ``(2,)`` or ``(3,)`` lowest.
        high: ``(2,)`` or ``(3,)`` highest.

    Raises:
        TypeError: for complex numbers or bools.
        ValueError: for actions of another size; or naming the vehicles whose action is not finite or beyond the bounds
            by more than rounding.

    Example:
        >>> checked_action(torch.tensor([[50.000001, 0.0]]), torch.tensor([0.0, -1.5]), torch.tensor([50.0, 1.5]))
        tensor([[50.,  0.]], dtype=torch.float64)
    """
    check_tensor(action=action)
    if action.shape[-1] != len(low):
        declared = len(low) > 2
        names = "distance, turn and declare" if declared else "distance and turn"
        hint = ": for a policy that does not declare, magrl.evaluate or DeclareArrival does" if declared else ""
        raise ValueError(f"an action must be {len(low)} numbers, {names}, got {action.shape[-1]}{hint}")
    action = action.double()
    slack = 1e-5 * (high - low)
    sound = (action >= low - slack) & (action <= high + slack)
    if torch.compiler.is_compiling() or action.is_cuda:
        torch._assert_async(sound.all(), "GeomagneticNavEnv: an action is not finite or out of bounds")
    elif not sound.all():
        bad = (~sound.all(-1)).nonzero().squeeze(-1)
        raise ValueError(
            f"GeomagneticNavEnv: actions of vehicles {bad[:8].tolist()} are not finite or out of bounds: "
            f"{action[bad[:8]].tolist()}; distance [km] must be in [0, {float(high[0])}] and turn [rad] in "
            f"[-{float(high[1]):.4f}, {float(high[1]):.4f}]{', declare in [-1, 1]' * (len(high) > 2)}"
        )
    return action.clamp(low, high)


def check_state(weights: Tensor) -> None:
    """Raise unless every vehicle has a state: TorchRL fills the states that a partial reset lacks with 0.

    Args:
        weights: ``(N, 3)`` weights of the objective, which are above 0.

    Example:
        >>> check_state(torch.ones(2, 3))
    """
    message = "a vehicle has no state (objective_weights {}): to reset the others alone, set '_reset' in the "
    require(weights > 0, weights, message + "TensorDict that reset(), step_mdp() or step_and_maybe_reset() returned")


def state_spec(observation: Composite) -> Composite:
    """Return the spec of the keys that a step reads; a transform may overwrite the others, as ``field``.

    Example:
        >>> bounds = torch.zeros(3), torch.ones(3)
        >>> "field" in state_spec(observation_spec(bounds, 50.0, 1.5)).keys()
        False
    """
    keys = [key for key in STATE_KEYS if key in observation.keys()]  # noqa: SIM118 - a Composite is no mapping
    return Composite({key: observation[key].clone() for key in keys}, shape=observation.shape)

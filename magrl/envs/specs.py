"""Keys of the navigation environment, and their specs, each for one vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from magrl.checks import check_tensor, require
from magrl.envs.regions import Regions
from magrl.errors.base import LEG_ERROR
from magrl.field import FieldBank, FieldModel, elements_at
from magrl.field.elements import measured_elements
from magrl.pilot.records import EpisodeRules
from magrl.transforms.episode import EPISODE_STREAM

REWARD_TERMS = ("reward_destination", "reward_proximity")
"""Privileged keys of the terms whose sum is ``reward``; 0 at a reset."""
DECLARED = "declared"
"""Flag that the vehicle has declared its arrival, where it must."""

_NORTH_EAST = torch.tensor((90.0, 180.0), dtype=torch.float64)
POSITION = Bounded(-_NORTH_EAST, _NORTH_EAST, dtype=torch.float64)
"""Spec of a latitude and a longitude [deg]."""
FLAG = Binary(1, dtype=torch.bool)
"""Spec of a flag."""
NUMBER, INTEGER = Unbounded((1,), dtype=torch.float32), Unbounded((1,), dtype=torch.int64)
"""Specs of a number without bounds."""


class Limits(NamedTuple):
    """What bounds the values of an environment.

    Args:
        field: lowest and highest D [deg], I [deg], B_H [nT], ``(3,)`` each.
        rules: rules of an episode.
        num_regions: number of regions.
        drift_km: how much farther than its command errors of motion may carry a vehicle [km].

    Example:
        >>> Limits((torch.zeros(3), torch.ones(3)), EpisodeRules()).leg.space.low
        tensor([ 0.0000, -1.5708])
    """

    field: tuple[Tensor, Tensor]
    rules: EpisodeRules
    num_regions: int = 1
    drift_km: float = 0.0

    @property
    def declared(self) -> bool:
        """Whether vehicles declare their arrival."""
        return self.rules.declared

    @property
    def leg(self) -> Bounded:
        """Spec of a leg: distance [km] and turn [rad]."""
        highest = torch.tensor((self.rules.max_leg_km, self.rules.max_turn_rad), dtype=torch.float32)
        return float_bounds(highest * torch.tensor((0, -1)), highest)

    @property
    def leg_error(self) -> Bounded:
        """Spec of the displacement from the end of a commanded leg to the end of the true one [km]."""
        reach = 2 * self.rules.max_leg_km + self.drift_km
        return Bounded(-reach, reach, (2,), dtype=torch.float64)


class Key(NamedTuple):
    """A key of what a vehicle observes after a step.

    Args:
        spec: spec of one vehicle, by the limits.
        public: whether every policy may read it.
        constant: whether a step leaves it as it is.
        state: whether a step reads it; so it does with what is constant.
        needs: name of the limit without which there is no such key.

    Example:
        >>> Key(lambda limits: FLAG).public
        False
    """

    spec: Callable[[Limits], TensorSpec]
    public: bool = False
    constant: bool = False
    state: bool = False
    needs: str = "field"


KEYS = {
    "field": Key(lambda limits: float_bounds(*limits.field), public=True),
    "target_field": Key(lambda limits: float_bounds(*limits.field), public=True, constant=True),
    "leg": Key(lambda limits: limits.leg, public=True),
    "heading": Key(lambda _: Bounded(-math.pi, math.pi, (1,), dtype=torch.float32), public=True, state=True),
    "elapsed_steps": Key(lambda _: INTEGER, public=True, state=True),
    "position": Key(lambda _: POSITION, state=True),
    "target_position": Key(lambda _: POSITION, constant=True),
    "start_position": Key(lambda _: POSITION, constant=True),
    "objective": Key(lambda _: NUMBER, state=True),
    "objective_weights": Key(lambda _: NUMBER.expand(3), constant=True),
    "success": Key(lambda _: FLAG),
    "region": Key(lambda limits: Bounded(0, limits.num_regions - 1, (1,), dtype=torch.int64), constant=True),
    EPISODE_STREAM: Key(lambda _: INTEGER, constant=True),
    **{term: Key(lambda _: NUMBER) for term in REWARD_TERMS},
    DECLARED: Key(lambda _: FLAG, public=True, needs="declared"),
    LEG_ERROR: Key(lambda limits: limits.leg_error, constant=True, needs="drift_km"),
}
"""Keys of the environment; a reset fills those with 0 that it does not name."""
PUBLIC_KEYS = tuple(name for name, key in KEYS.items() if key.public and name not in ("elapsed_steps", DECLARED))
"""Keys that every policy may read, beside ``elapsed_steps``."""
PRIVILEGED_KEYS = tuple(name for name, key in KEYS.items() if not key.public and name != LEG_ERROR)
"""Keys that a policy may not read if it navigates by the field alone; :data:`magrl.errors.TRUE_KEYS` has others."""


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
            "a field of a larger box, or a smaller region, margin_deg or max_leg_km"
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
    grid = regions.grid(points)
    values = measured_elements(field.on_grids(grid)[0]) if isinstance(field, FieldBank) else elements_at(field, grid)
    return values.flatten(1, 2)


def observation_spec(limits: Limits) -> Composite:
    """Return the spec of what a vehicle observes after a step, privileged keys included.

    Example:
        >>> observation_spec(Limits((torch.zeros(3), torch.ones(3)), EpisodeRules())).expand(4)["field"].shape
        torch.Size([4, 3])
    """
    return Composite({name: key.spec(limits).clone() for name, key in KEYS.items() if getattr(limits, key.needs)})


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
    if torch.compiler.is_compiling() or action.device.type != "cpu":
        require(sound, action, "GeomagneticNavEnv: an action is not finite or out of bounds")
    elif not sound.all():
        bad = (~sound.all(-1)).nonzero().squeeze(-1)[:8]
        scaled = (2 * (action[bad] - low) / (high - low) - 1).double().round(decimals=6)
        raise ValueError(
            f"GeomagneticNavEnv: actions of vehicles {bad.tolist()} are not finite or out of bounds, {scaled.tolist()} "
            f"in [-1, 1]: clip them; or {action[bad].tolist()} as distance [0, {float(high[0])}] km and turn "
            f"[-{float(high[1]):.4f}, {float(high[1]):.4f}] rad{', declare [-1, 1]' * (len(high) > 2)}"
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
        >>> limits = Limits((torch.zeros(3), torch.ones(3)), EpisodeRules())
        >>> "field" in state_spec(observation_spec(limits)).keys()
        False
    """
    state = {name: spec.clone() for name, spec in observation.items() if KEYS[name].state or KEYS[name].constant}
    return Composite(state, shape=observation.shape)

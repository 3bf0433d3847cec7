"""The navigation environment: a batch of vehicles that read the magnetic field and move.

It speaks physical units and gives the paper's base reward (arrival and proximity). Everything else (guidance,
scaling, concatenation) is a transform on top of it. The state lives in the TensorDict; the env itself holds only
its options and, per vehicle, the number of the journey that it is on.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from magrl import guidance
from magrl.checks import check_number, check_numbers, check_type
from magrl.fields import IGRF, Date, FieldModel, elements_at, elements_range
from magrl.geodesy import move, wrap_angle
from magrl.regional import RegionalField
from magrl.tasks import (
    PAPER_DISTANCE_KM,
    PAPER_REGION,
    Region,
    Tasks,
    check_distance_range,
    check_tasks,
    counter_uniform,
    sample_tasks,
)

PAPER_DATE = "2022-01-01"
PAPER_GENERATION = 13
PRIVILEGED_KEYS = (
    "position",
    "target_position",
    "start_position",
    "objective",
    "objective_weights",
    "success",
)
"""What no policy that claims to navigate by the field may read."""

SHORTEST_DEGREE_KM = 110.5
"""A degree of arc is nowhere shorter on the ellipsoid."""
_HEADING_STREAM = -1  # the counter that sets a start heading apart from the attempts at placing a task


def paper_field(
    region: Region = PAPER_REGION,
    margin_deg: float = 5.0,
    max_move_km: float = 50.0,
    date: Date = PAPER_DATE,
    generation: int = PAPER_GENERATION,
    altitude_km: float = 0.0,
) -> RegionalField:
    """IGRF on a region and on the margin into which a vehicle can stray.

    Args:
        region: where tasks lie.
        margin_deg: how far beyond it a vehicle may be before it is lost [deg].
        max_move_km: longest move, so that the place where a vehicle is lost is still inside [km].
        date: see :data:`magrl.fields.Date`.
        generation: of IGRF, 13 or 14.
        altitude_km: over the ellipsoid, at which the field is read [km]; moves and gradients are over the ground.

    Raises:
        ValueError: for a date outside the model, or a box too large for the expansion.

    Example:
        >>> paper_field().latitude
        (-15.5, 5.5)
    """
    box = flown_box(region, margin_deg, max_move_km)
    return RegionalField(IGRF(date, generation, altitude_km=altitude_km), box.latitude, box.longitude)


def flown_box(region: Region, margin_deg: float, max_move_km: float) -> Region:
    """Every place that a vehicle can reach: the region, its margin, and one move beyond, to the next half degree.

    Raises:
        ValueError: for a margin or a move that is negative or not finite.

    Example:
        >>> flown_box(PAPER_REGION, margin_deg=5, max_move_km=50)
        Region(latitude=(-15.5, 5.5), longitude=(154.5, 175.5))
    """
    check_type(Region, region=region)
    check_number(0, margin_deg=margin_deg, max_move_km=max_move_km)
    edge = region.expanded(margin_deg)
    reach = math.radians(max_move_km / SHORTEST_DEGREE_KM)
    nearest_pole = math.radians(90 - max(abs(x) for x in edge.latitude))
    # The farthest that a great circle of this length leads from its meridian; past a pole it leads anywhere.
    aside = math.degrees(math.asin(math.sin(reach) / math.sin(nearest_pole))) if reach < nearest_pole else 180.0
    south_north, west_east = (math.ceil(2 * x) / 2 for x in (math.degrees(reach), aside))
    return Region(edge.expanded(south_north).latitude, edge.expanded(west_east).longitude)


class GeomagneticNavEnv(EnvBase):
    """Vehicles that cross a region to a place of which they know only the magnetic elements.

    Each vehicle reads D, I, B_H where it is, knows those of its destination, its own heading from true north and
    its last move; it chooses how far to go and how far to turn first. It has arrived once the objective F (Eq. 2-6)
    is under ``zeta``. Leaving the region by more than ``margin_deg`` loses it: the episode ends as a failure.

    Args:
        num_envs: vehicles in the batch.
        region: where tasks lie.
        distance_range_km: shortest and longest journey [km].
        tasks: a frozen set to fly instead of random tasks: in episode k, vehicle i flies task ``i + k * num_envs``,
            counted around the set.
        field: field model; by default :func:`paper_field` of the region.
        max_steps: moves after which an episode is truncated.
        max_move_km: longest move [km].
        max_turn_rad: largest turn to either side before a move [rad].
        zeta: arrival threshold on the objective.
        start_heading: ``"north"``, or ``"random"`` for any heading.
        objective_floors: least differences that Eq. 2-6 divides by: D [deg], I [deg], B_H [nT].
        destination_weight: reward at arrival, zeta_1.
        proximity_weight: reward per unit of the objective, zeta_2.
        margin_deg: how far beyond the region a vehicle may stray [deg].
        seed: of tasks and start headings; random if None.
        device: where the batch lives.

    Raises:
        ValueError: for any option out of its range, naming it and its value.

    Keys (``N = num_envs``): ``field``, ``target_field`` ``(N, 3)`` D [deg], I [deg], B_H [nT]; ``move`` ``(N, 2)`` last
    move [km] and turn [rad]; ``heading`` ``(N, 1)`` [rad]; ``step_count`` ``(N, 1)``; and privileged ``position``,
    ``target_position``, ``start_position`` ``(N, 2)`` [deg], ``objective``, ``success`` ``(N, 1)``,
    ``objective_weights`` ``(N, 3)``. Action ``(N, 2)``: distance [km], turn [rad].

    Example:
        >>> env = GeomagneticNavEnv(num_envs=4, seed=0)
        >>> env.rollout(3)["next", "field"].shape
        torch.Size([4, 3, 3])
    """

    batch_locked = True
    episode: Tensor

    def __init__(
        self,
        *,
        num_envs: int = 1,
        region: Region = PAPER_REGION,
        distance_range_km: tuple[float, float] = PAPER_DISTANCE_KM,
        tasks: Tasks | None = None,
        field: FieldModel | None = None,
        max_steps: int = 50,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        zeta: float = 0.01,
        start_heading: str = "north",
        objective_floors: Sequence[float] = guidance.OBJECTIVE_FLOORS,
        destination_weight: float = 200.0,
        proximity_weight: float = 10.0,
        margin_deg: float = 5.0,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        check_number(1, whole=True, num_envs=num_envs, max_steps=max_steps)
        check_number(0, 2**64 - 1, whole=True, seed=0 if seed is None else seed)
        check_number(0, 1000, above=True, max_move_km=max_move_km)  # a move is one short leg
        check_number(0, math.pi, above=True, max_turn_rad=max_turn_rad)
        check_number(0, above=True, zeta=zeta)
        check_number(0, destination_weight=destination_weight, proximity_weight=proximity_weight, margin_deg=margin_deg)
        if start_heading not in ("north", "random"):
            raise ValueError(f"start_heading must be 'north' or 'random', got {start_heading!r}")
        check_numbers(2, distance_range_km=distance_range_km)
        check_numbers(3, objective_floors=objective_floors)
        if min(objective_floors) <= 0:
            raise ValueError(f"objective_floors must be three positive numbers (deg, deg, nT), got {objective_floors}")
        check_type(Region, region=region)
        if not (field is None or callable(field)):
            raise TypeError(f"field must be called as field(latitude, longitude), got {field!r}")
        if tasks is None:
            check_distance_range(region, distance_range_km)
        super().__init__(device=device or "cpu", batch_size=torch.Size([num_envs]))
        self.num_envs, self.max_steps, self.zeta = num_envs, max_steps, float(zeta)
        self.region, self.edge = region, region.expanded(margin_deg)
        self.distance_range_km = (float(distance_range_km[0]), float(distance_range_km[1]))
        self.max_move_km, self.max_turn_rad = float(max_move_km), float(max_turn_rad)
        self.start_heading = start_heading
        self.destination_weight, self.proximity_weight = float(destination_weight), float(proximity_weight)
        self.tasks = None if tasks is None else Tasks(*(x.to(self.device) for x in check_tasks(tasks, self.edge)))
        if field is None:
            field = paper_field(region, margin_deg, max_move_km)
        self.field = field.to(self.device) if isinstance(field, torch.nn.Module) else field
        float64: dict[str, Any] = {"dtype": torch.float64, "device": self.device}
        self._track: deque[tuple[Tensor, ...]] = deque(maxlen=max_steps + 1)
        self.register_buffer("objective_floors", torch.tensor(tuple(objective_floors), **float64))
        self.register_buffer("action_low", torch.tensor((0.0, -self.max_turn_rad), **float64))
        self.register_buffer("action_high", torch.tensor((self.max_move_km, self.max_turn_rad), **float64))
        self.register_buffer("vehicle", torch.arange(num_envs, device=self.device))
        self.register_buffer("episode", torch.zeros(num_envs, dtype=torch.int64, device=self.device))
        self._make_specs(flown_box(region, margin_deg, max_move_km))
        self.set_seed(int(torch.randint(2**31, ())) if seed is None else seed)

    # Specs

    def _make_specs(self, box: Region) -> None:
        low, high = self._field_bounds(box)
        turn = torch.tensor(self.max_turn_rad, dtype=torch.float32)
        distance = torch.tensor(self.max_move_km, dtype=torch.float32)
        observation = Composite(
            field=self._bounded(low, high),
            target_field=self._bounded(low, high),
            move=self._bounded(torch.stack((0 * distance, -turn)), torch.stack((distance, turn))),
            heading=self._bounded(torch.tensor([-math.pi]), torch.tensor([math.pi])),
            step_count=Unbounded((self.num_envs, 1), dtype=torch.int64),
            position=self._position_spec(),
            target_position=self._position_spec(),
            start_position=self._position_spec(),
            objective=Unbounded((self.num_envs, 1)),
            objective_weights=Unbounded((self.num_envs, 3)),
            success=Binary(1, (self.num_envs, 1), dtype=torch.bool),
            shape=(self.num_envs,),
        ).to(self.device)
        self.observation_spec = observation
        self.state_spec = observation.clone()
        self.action_spec = self._bounded(self.action_low.float(), self.action_high.float())
        self.reward_spec = Unbounded((self.num_envs, 1), device=self.device)
        flag = Binary(1, (self.num_envs, 1), dtype=torch.bool, device=self.device)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(self.num_envs,), device=self.device
        )

    def _bounded(self, low: Tensor, high: Tensor) -> Bounded:
        shape = (self.num_envs, *low.shape)
        return Bounded(low.float().expand(shape), high.float().expand(shape), shape, device=self.device)

    def _position_spec(self) -> Bounded:
        high = torch.tensor((90.0, 180.0), dtype=torch.float64).expand(self.num_envs, 2)
        return Bounded(-high, high, high.shape, dtype=torch.float64, device=self.device)

    def _field_bounds(self, box: Region) -> tuple[Tensor, Tensor]:
        """Bounds of D, I, B_H over every place that can be reached, ``(3,)`` each, from a grid and 5 % of slack."""
        low, high = elements_range(self.field, box.grid(81).to(self.device))
        if not torch.isfinite(low + high).all():
            raise ValueError(f"the field is not defined on all of {box}, which vehicles of these options can reach")
        if high[0] - low[0] > 180:
            raise ValueError(f"the declination turns through south in {box}: D jumps from 180 to -180 degrees there")
        slack = 0.05 * (high - low)
        limit = torch.tensor((180.0, 90.0, math.inf), dtype=torch.float64, device=self.device)
        return (low - slack).maximum(-limit), (high + slack).minimum(limit)

    # Reset

    def _set_seed(self, seed: int | None) -> None:
        check_number(0, 2**64 - 1, whole=True, seed=seed)
        assert seed is not None  # it was refused above
        self.seed = int(seed)
        self.episode = torch.zeros_like(self.episode)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        """Starts the next journey of every vehicle that is named by ``_reset``, or of all."""
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            chosen, start = self.vehicle, self._start_of(self.vehicle)
        else:
            mask = mask.reshape(self.num_envs)
            chosen = mask.nonzero().squeeze(-1)
            # The rows of the others are placeholders: the base class puts their running state back.
            rows = self._start_of(chosen if len(chosen) else self.vehicle[:1])
            start = rows[(mask.cumsum(0) - 1).clamp_min(0)]
        # Counted out of place: a rollout or a checkpoint may hold the old tensor.
        self.episode = self.episode.index_add(0, chosen, torch.ones_like(chosen))
        self._remember(start, mask)
        return start

    def _start_of(self, vehicle: Tensor) -> TensorDict:
        """The first observation of the next journey of some vehicles, ``(P,)``."""
        episode = self.episode[vehicle]
        tasks = self._tasks(vehicle, episode)
        field, target_field = elements_at(self.field, torch.stack(tasks))
        # As the vehicle reads it: a move of no length must not change the objective by a rounding.
        field, target_field = field.float().double(), target_field.float().double()
        weights = guidance.objective_weights(field, target_field, self.objective_floors).float().double()
        zeros = field.new_zeros(len(vehicle), 2)
        flags = {key: torch.zeros_like(zeros[:, :1], dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        return TensorDict(
            {
                "field": field.float(),
                "target_field": target_field.float(),
                "move": zeros.float(),
                "heading": self._start_heading(vehicle, episode).float(),
                "step_count": torch.zeros_like(vehicle).unsqueeze(-1),
                "position": tasks.start,
                "target_position": tasks.target,
                "start_position": tasks.start,
                "objective": guidance.objective(field, target_field, weights).float(),
                "objective_weights": weights.float(),
                "success": flags["done"].clone(),
                **flags,
            },
            batch_size=vehicle.shape,
            device=self.device,
        )

    def _tasks(self, vehicle: Tensor, episode: Tensor) -> Tasks:
        if self.tasks is None:
            return sample_tasks(self.region, self.distance_range_km, self.seed, vehicle, episode)
        index = (vehicle + episode * self.num_envs) % len(self.tasks.start)
        return Tasks(self.tasks.start[index], self.tasks.target[index])

    def _start_heading(self, vehicle: Tensor, episode: Tensor) -> Tensor:
        if self.start_heading == "north":
            return torch.zeros(len(vehicle), 1, dtype=torch.float64, device=self.device)
        stream = torch.full_like(vehicle, _HEADING_STREAM)
        uniform = counter_uniform(self.seed, torch.stack((vehicle, episode, stream), -1), 1)
        return wrap_angle(2 * math.pi * uniform)

    # Step

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._checked_action(tensordict["action"])
        distance, turn = action.unbind(-1)
        before = tensordict["position"]
        heading = wrap_angle(tensordict["heading"].squeeze(-1).double() + turn)
        latitude, longitude = before.unbind(-1)
        moved = torch.stack(move(latitude, longitude, heading, distance), -1)
        was_inside, is_inside = self.edge.contains(torch.stack((before, moved))).unbind(0)
        position = torch.where(was_inside, moved, before)  # the lost stay where they were lost
        lost = ~(was_inside & is_inside)

        field = elements_at(self.field, position)
        field = field.float().double()
        weights = tensordict["objective_weights"].double()
        objective = guidance.objective(field, tensordict["target_field"].double(), weights)
        arrived = (objective < self.zeta) & ~lost
        step = tensordict["step_count"] + 1
        terminated = arrived | lost
        truncated = (step >= self.max_steps) & ~terminated
        proximity = guidance.proximity_reward(tensordict["objective"].double(), objective, self.proximity_weight)
        reward = guidance.destination_reward(arrived, self.destination_weight) + guidance.late_decay(
            proximity, step, self.max_steps
        )
        after = TensorDict(
            {
                "field": field.float(),
                "target_field": tensordict["target_field"],
                "move": action.float(),
                "heading": heading.float().unsqueeze(-1),
                "step_count": step,
                "position": position,
                "target_position": tensordict["target_position"],
                "start_position": tensordict["start_position"],
                "objective": objective.float(),
                "objective_weights": tensordict["objective_weights"],
                "success": arrived,
                "reward": reward.float(),
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            batch_size=tensordict.batch_size,
            device=self.device,
        )
        self._remember(after)
        return after

    def _checked_action(self, action: Tensor) -> Tensor:
        """The action in float64, rounded into its bounds.

        Raises:
            ValueError: naming the vehicles whose action is not finite or beyond the bounds by more than rounding.
        """
        action = action.double()
        slack = 1e-5 * (self.action_high - self.action_low)
        sound = (action >= self.action_low - slack) & (action <= self.action_high + slack)
        if torch.compiler.is_compiling() or action.is_cuda:
            torch._assert_async(sound.all(), "GeomagneticNavEnv: an action is not finite or out of bounds")
        elif not sound.all():
            bad = (~sound.all(-1)).nonzero().squeeze(-1)
            raise ValueError(
                f"GeomagneticNavEnv: actions of vehicles {bad[:8].tolist()} are not finite or out of bounds: "
                f"{action[bad[:8]].tolist()}; distance [km] must be in [0, {self.max_move_km}] and turn [rad] in "
                f"[-{self.max_turn_rad:.4f}, {self.max_turn_rad:.4f}]"
            )
        return action.clamp(self.action_low, self.action_high)

    # Pictures

    def _remember(self, state: TensorDictBase, mask: Tensor | None = None) -> None:
        """Keeps the positions of the running episodes for :meth:`render`; rows in ``mask`` start anew."""
        if torch.compiler.is_compiling():
            return
        entry: tuple[Tensor, ...] = (state["position"], state["step_count"], state["target_position"])
        if mask is not None and self._track:
            started = mask.unsqueeze(-1)
            last = self._track.pop()
            entry = tuple(torch.where(started, new, old) for new, old in zip(entry, last, strict=True))
        self._track.append(entry)

    def track(self, vehicle: int) -> Tensor:
        """Where a vehicle has been in its running episode, start first: ``(T, 2)`` latitude, longitude [deg].

        Raises:
            RuntimeError: before the first reset.
            IndexError: for a vehicle that the batch does not hold.
        """
        if not self._track:
            raise RuntimeError("there is no episode to show yet: call reset() first")
        check_number(whole=True, vehicle=vehicle)
        if not 0 <= vehicle < self.num_envs:
            raise IndexError(f"vehicle {vehicle} is not one of the {self.num_envs} in the batch")
        since = int(self._track[-1][1][vehicle])
        return torch.stack([entry[0][vehicle] for entry in list(self._track)[-(since + 1) :]])

    def render(self, vehicles: Sequence[int] | None = None, *, size_px: int = 700) -> np.ndarray:
        """A picture of the running episodes over the field's contours.

        Args:
            vehicles: which to draw; the first 16 by default.
            size_px: height and width [pixels].

        Returns:
            ``(size_px, size_px, 3)`` uint8 RGB.

        Raises:
            RuntimeError: before the first reset.
            IndexError: for a vehicle that the batch does not hold.
        """
        from magrl import plots  # matplotlib is heavy, and only needed for pictures

        chosen = range(min(self.num_envs, 16)) if vehicles is None else vehicles
        paths = [self.track(vehicle).cpu() for vehicle in chosen]
        targets = self._track[-1][2][list(chosen)].cpu()
        return plots.rgb_array(plots.draw_journeys, size_px, self.field, self.region, paths, targets)

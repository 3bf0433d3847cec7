"""The navigation environment: a batch of vehicles that measure the magnetic field and move.

It works in physical units and gives the paper's base reward (arrival and proximity). Guidance, scaling and
concatenation are transforms on top of it. The state lives in the TensorDict; the environment itself holds its options
and the number of the episode that each vehicle is in.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import partial
from typing import Any, Self

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from magrl import guidance
from magrl.checks import check_choice, check_device, check_number, check_type
from magrl.envs import specs
from magrl.envs.regions import Regions, one_region
from magrl.envs.rendering import TrackRecorder, draw_tracks, rgb_array
from magrl.envs.scenario import Scenario
from magrl.envs.trips import Trips, random_headings, sample_trips
from magrl.errors.base import LEG_ERROR
from magrl.field import elements_at, elements_range
from magrl.geodesy import displaced, geodesic, move, polar, wrap_angle
from magrl.pilot.records import EpisodeRules
from magrl.random_numbers import FIRST_RESERVED_SEED, counter_stream
from magrl.transforms.episode import EPISODE_STREAM
from magrl.transforms.views import ObservationView


class GeomagneticNavEnv(EnvBase):
    """Vehicles that cross a region to a destination of which they know only the magnetic elements.

    Each vehicle measures D, I, B_H; it knows those of its destination, its heading from true north and its last leg.
    It chooses how far to turn and then how far to go. It has arrived when the objective F (Eq. (6)) is below ``zeta``.
    A vehicle that leaves the region by more than the scenario's margin is lost: the episode ends as a failure. Where
    the scenario has several regions, each episode draws its own.

    Args:
        scenario: region, field, trips, and rules of an episode; by default the paper's. Where it has frozen trips,
            vehicle i flies trip ``i + k * num_envs`` in episode k, counted around the set.
        num_envs: number of vehicles in the batch.
        drift_km: how much farther than its command a :class:`~magrl.errors.MotionError` may carry a vehicle [km].
            Above 0, the key ``leg_error`` ``(N, 2)`` holds what such an error adds to a leg, northward and eastward
            [km].
        destination_weight: reward at arrival, zeta_1.
        proximity_weight: reward per unit of the objective, zeta_2.
        objective_limit: upper bound on the objective in that reward; None, as in the paper.
        render_mode: ``"rgb_array"`` to keep the tracks that :meth:`render` draws, or None.
        seed: seed of trips and start headings; by default a random training seed.
        device: device of the batch.
        **changes: fields of :class:`Scenario` that replace those of the scenario, such as ``max_steps``.

    Raises:
        TypeError: for an unknown option, with the list of options.
        ValueError: for an option out of its range, naming it and its value.

    Attributes:
        vehicle: ``(N,)`` number of each vehicle, from 0 on. With its seed and its episode it determines trip, start
            heading and errors, so that an environment of few vehicles with other numbers repeats episodes of a larger
            one.

    ``reset(TensorDict(position=..., target_position=...), set_state=True)`` begins episodes at places of one's own,
    with ``heading`` and ``region`` if given, and ``reset(state, set_state=True)`` at a state. Transforms begin anew
    there; to go on from a state with theirs, call ``step`` with it: it is wholly in the TensorDict.

    Keys (``N = num_envs``; float32, but positions float64, and counts and indices int64):

    - ``action`` ``(N, 2)``: distance [km] and turn [rad]; ``(N, 3)`` where the arrival is declared, by a number above 0
    - ``field``, ``target_field`` ``(N, 3)``: D [deg], I [deg], B_H [nT], of the vehicle and of its destination
    - ``leg`` ``(N, 2)``: last leg, distance [km] and turn [rad]
    - ``heading`` ``(N, 1)``: from true north [rad]
    - ``elapsed_steps`` ``(N, 1)``
    - ``declared`` ``(N, 1)``: bool, where the arrival is declared
    - ``reward``, ``done``, ``terminated``, ``truncated`` ``(N, 1)``
    - privileged: ``position``, ``target_position``, ``start_position`` ``(N, 2)``: latitude and longitude [deg]
    - privileged: ``objective`` ``(N, 1)``: F; ``objective_weights`` ``(N, 3)``: of D, I, B_H
    - privileged: ``success`` ``(N, 1)``: bool
    - privileged: ``region`` ``(N, 1)``: index of the region
    - privileged: ``episode_stream`` ``(N, 1)``: number of seed, vehicle and episode, for random numbers of transforms
    - privileged: ``reward_destination``, ``reward_proximity`` ``(N, 1)``: terms of the reward

    Example:
        >>> env = GeomagneticNavEnv(num_envs=4, seed=0, max_steps=80)
        >>> env.rollout(3)["next", "field"].shape
        torch.Size([4, 3, 3])
    """

    batch_locked = True
    _supports_set_state = True  # TorchRL's declaration that reset(state, set_state=True) starts from a state
    action_low: Tensor
    action_high: Tensor
    objective_floors: Tensor
    vehicle: Tensor
    episode: Tensor
    field: Any  # a field model, or a bank of them
    view: Any  # what an agent observes; :func:`magrl.envs.navigation.navigation_env` writes it

    def __init__(
        self,
        scenario: Scenario | None = None,
        *,
        num_envs: int = 1,
        drift_km: float = 0.0,
        destination_weight: float = 200.0,
        proximity_weight: float = 10.0,
        objective_limit: float | None = None,
        render_mode: str | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
        **changes: Any,
    ) -> None:
        scenario = Scenario() if scenario is None else scenario
        check_type(Scenario, scenario=scenario)
        check_number(1, 10**8, whole=True, num_envs=num_envs)
        check_number(0, destination_weight=destination_weight, proximity_weight=proximity_weight, drift_km=drift_km)
        check_number(0, above=True, optional=True, objective_limit=objective_limit)
        check_choice((None, "rgb_array"), render_mode=render_mode)
        if unknown := sorted(changes.keys() - Scenario.model_fields.keys()):
            options = f"those of GeomagneticNavEnv and {sorted(Scenario.model_fields)}"
            # Python's wording: TorchRL's GymEnv looks for it to find out which arguments it can pass.
            raise TypeError(f"got an unexpected keyword argument {unknown[0]!r}; the options are {options}")
        check_choice(("cpu", "cuda", "xpu"), device=str(device or "cpu").partition(":")[0])  # those with float64
        check_device(device or "cpu")
        super().__init__(device=device or "cpu", batch_size=torch.Size([num_envs]))
        self.num_envs, self.drift_km, self.objective_limit = num_envs, float(drift_km), objective_limit
        self.destination_weight, self.proximity_weight = float(destination_weight), float(proximity_weight)
        self._place(scenario.replace(**changes))
        self.render_mode = render_mode
        self._tracks = TrackRecorder(self.max_steps + 1 if render_mode else 0)
        self.register_buffer("vehicle", torch.arange(num_envs, device=self.device))
        self.register_buffer("episode", torch.zeros(num_envs, dtype=torch.int64, device=self.device))
        self._ahead: TensorDict | None = None
        self._make_specs(self.edge.reachable(self.max_leg_km + self.drift_km))
        self.set_seed(int(torch.randint(FIRST_RESERVED_SEED, ())) if seed is None else seed)

    def _place(self, scenario: Scenario) -> None:
        """Keep the rules of a scenario, and its regions, trips and field on the device of the batch."""
        self.scenario = scenario
        self.max_steps, self.max_leg_km, self.max_turn_rad = (
            getattr(scenario, name) for name in ("max_steps", "max_leg_km", "max_turn_rad")
        )
        self.arrival, self.zeta, self.start_heading = scenario.arrival, scenario.zeta, scenario.start_heading
        high = self.max_leg_km, self.max_turn_rad, *([1.0] if scenario.declared else [])
        self.register_buffer("action_high", torch.tensor(high, dtype=torch.float64, device=self.device))
        self.register_buffer("action_low", torch.cat((self.action_high.new_zeros(1), -self.action_high[1:])))
        # Modules of the scenario stay where they are.
        self.region, self.edge = copy.deepcopy(scenario.region).to(self.device), scenario.edge.to(self.device)
        self.trips = scenario.trips and Trips(*(values.to(self.device) for values in scenario.trips))
        field = scenario.build_field(self.drift_km)
        self.register_buffer("objective_floors", scenario.floors(field).to(self.device))
        if isinstance(field, torch.nn.Module):  # a copy, which shares its buffers until one of them is moved
            field = copy.deepcopy(field, {id(values): values for values in field.buffers()}).to(self.device)
        self.field = field

    @property
    def limits(self) -> dict[str, Any]:
        """The rules that a vehicle knows before it starts, for :class:`magrl.pilot.Rules`."""
        return self.scenario.model_dump(include=set(EpisodeRules.model_fields))

    def observation_view(self, **observed: bool) -> ObservationView:
        """Return what an agent observes of this environment, scaled to the range of the field over the region.

        Args:
            **observed: ``observe_heading``, ``observe_difference`` and ``observe_areas`` of
                :class:`~magrl.transforms.ObservationView`.

        Raises:
            ValueError: over several regions, which have no range in common.

        Example:
            >>> GeomagneticNavEnv(seed=0).observation_view().size
            13
        """
        one_region(self.region)
        low, high = elements_range(self.field, self.region.grid(81))
        return ObservationView(
            field_low=tuple(low.tolist()),
            field_high=tuple(high.tolist()),
            max_leg_km=self.max_leg_km,
            max_turn_rad=self.max_turn_rad,
            **observed,
        )

    # Specs

    def _make_specs(self, boxes: Regions) -> None:
        bounds = specs.field_bounds(self.field, boxes)
        limits = specs.Limits(bounds, self.scenario, len(self.region), self.drift_km)
        self.observation_spec = self._batched(specs.observation_spec(limits))
        self.state_spec = specs.state_spec(self.observation_spec)
        self._constant_keys = [name for name, _ in self.state_spec.items() if specs.KEYS[name].constant]  # noqa: PERF102
        self.action_spec = self._batched(specs.float_bounds(self.action_low, self.action_high))
        self.reward_spec = self._batched(Unbounded((1,), dtype=torch.float32))
        self.full_done_spec = self._batched(Composite(dict.fromkeys(("done", "terminated", "truncated"), specs.FLAG)))

    def to(self, device: Any) -> Self:
        """Move the environment to a device."""
        check_device(device)
        self._ahead = None
        return super().to(device)

    def _load_from_state_dict(self, *args: Any) -> None:
        self._ahead = None
        super()._load_from_state_dict(*args)

    def _batched(self, spec: TensorSpec) -> TensorSpec:
        return spec.expand(self.num_envs, *spec.shape).to(self.device)

    # Reset

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Set the seed; return the next one, of another environment: reserved for evaluations if this one is.

        TorchRL's next seed is any number below 2**32.
        """
        following = super().set_seed(seed, static_seed)
        reserved = self.seed >= FIRST_RESERVED_SEED
        return following if static_seed else following % FIRST_RESERVED_SEED + reserved * FIRST_RESERVED_SEED

    def _set_seed(self, seed: Any) -> None:
        check_number(0, 2**64 - 1, whole=True, seed=seed)
        self.seed = int(seed)
        self.episode = torch.zeros_like(self.episode)

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **_: Any) -> TensorDictBase:
        """Start the next episode of every vehicle that is named by ``_reset``, or of all; or all from a state."""
        mask = torch.ones_like(self.vehicle, dtype=torch.bool)
        from_state = set_state and tensordict is not None and "_reset" not in tensordict.keys()  # noqa: SIM118
        if tensordict is not None:
            mask = tensordict.get("_reset", mask).reshape(self.num_envs)
        # The base class puts the running state of the others back
        start = self._from_state(tensordict) if from_state else self._next_starts(mask)
        self.episode = self.episode + mask  # out of place: a rollout or a checkpoint may hold the old tensor
        self._tracks.add(start, mask)
        return start

    def _reset_proc_data(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """Return the state of all vehicles: those that are not reset keep theirs."""
        state = super()._reset_proc_data(tensordict, tensordict_reset)
        specs.check_state(state["objective_weights"])
        return state

    def _next_starts(self, mask: Tensor) -> TensorDict:
        """Return the starts of the next episodes ``(N,)``; those outside ``mask`` may be of episodes before.

        A start of many vehicles costs hardly more than one: all that were used are computed together, and kept.
        """
        if self._ahead is None:
            self._ahead = self._start_of(torch.arange(self.num_envs, device=self.device))
        used = (self._ahead[EPISODE_STREAM] != self._streams(self.vehicle, self.episode)).squeeze(-1)
        if (used & mask).any():
            rows = used.nonzero().squeeze(-1)
            self._ahead = self._ahead.clone()  # tensors of an inference mode cannot be written outside of it
            self._ahead[rows] = self._start_of(rows)
        return self._ahead.clone()  # who is given it may write into it

    def _from_state(self, state: TensorDictBase) -> TensorDict:
        """Return the observation of a state, or of an episode that begins at some places.

        Raises:
            KeyError: for a part of a state.
            ValueError: for a place outside the region.
        """
        keys, places, first = set(self.state_spec.keys()), {"position", "target_position"}, {"heading", "region"}
        given = keys & set(state.keys())
        if missing := sorted((places if given <= places | first else keys) - given):
            raise KeyError(f"a state lacks {missing}: give all of {sorted(keys)}, or {sorted(places)} alone")
        region = state.get("region", torch.zeros_like(self.vehicle)).reshape(self.num_envs)
        ends = torch.stack((state["position"], state["target_position"])).double()
        if not self.edge.contains(ends, region).all():
            raise ValueError(f"position and target_position must be in the region and its margin, got {ends.tolist()}")
        self._tracks = TrackRecorder(self.max_steps + 1 if self.render_mode else 0)  # what came before is not known
        start = self._start_of(torch.arange(self.num_envs, device=self.device), Trips(ends[0], ends[1], region))
        for key in (given | {"leg"} & set(state.keys())) - places - {"target_field"}:
            start[key] = state[key].to(start[key])
        return start

    def _streams(self, vehicle: Tensor, episode: Tensor) -> Tensor:
        """Return the stream of random numbers of episodes, ``(P, 1)``, which names an episode of any seed."""
        return counter_stream(self.seed, torch.stack((vehicle, episode), -1)).unsqueeze(-1)

    def _start_of(self, row: Tensor, trips: Trips | None = None) -> TensorDict:
        """Return the first observation of the next episode of the vehicles in some rows, ``(P,)``."""
        vehicle, episode = self.vehicle[row], self.episode[row]
        start, target, region = self._trips(vehicle, episode) if trips is None else trips
        field, target_field = elements_at(self.field, torch.stack((start, target)), region)
        # Rounded as the vehicle observes it: a leg of length 0 must not change the objective.
        field, target_field = field.float().double(), target_field.float().double()
        weights = guidance.objective_weights(field, target_field, self.objective_floors[region]).float().double()
        values = {
            "field": field.float(),
            "target_field": target_field.float(),
            "position": start,
            "target_position": target,
            "start_position": start,
            "objective": guidance.objective(field, target_field, weights).float(),
            "objective_weights": weights.float(),
            "region": region.unsqueeze(-1),
            EPISODE_STREAM: self._streams(vehicle, episode),
        }
        if self.start_heading == "random":
            values["heading"] = random_headings(self.seed, vehicle, episode).float()
        others = {**self.observation_spec, **self.full_done_spec}
        zeros = {name: spec.zero()[row] for name, spec in others.items() if name not in values}
        return TensorDict(values | zeros, batch_size=vehicle.shape, device=self.device)

    def _trips(self, vehicle: Tensor, episode: Tensor) -> Trips:
        if self.trips is None:
            distances, law = self.scenario.distance_range_km, self.scenario.distance_law
            return sample_trips(self.region, distances, self.seed, vehicle, episode, law)
        rows = (vehicle + episode * self.num_envs) % len(self.trips.start)
        return Trips(*(values.to(self.device)[rows] for values in self.trips))  # the batch may have moved

    # Step

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = specs.checked_action(tensordict["action"], self.action_low, self.action_high)
        specs.check_state(tensordict["objective_weights"])
        moved, lost = self._moved(tensordict, action)
        ended, arrived = self._arrival(tensordict, action, moved)
        step, success, terminated = tensordict["elapsed_steps"] + 1, arrived & ended & ~lost, ended | lost
        truncated = (step >= self.max_steps) & ~terminated
        ends = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated, "success": success}
        if self.scenario.declared:
            ends[specs.DECLARED] = ended
        rewards = self._rewards(tensordict["objective"].double(), moved["objective"], step, success)
        return self._recorded(tensordict, moved | ends | rewards | {"elapsed_steps": step})

    def _moved(self, tensordict: TensorDictBase, action: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        """Return the keys that a leg changes, the objective in float64, and who is lost ``(N, 1)``."""
        distance, turn = action[:, :2].unbind(-1)
        before, region = tensordict["position"], tensordict["region"].squeeze(-1)
        heading = course = wrap_angle(tensordict["heading"].squeeze(-1).double() + turn)
        if self.drift_km:
            distance, course = polar(displaced(distance, heading, tensordict[LEG_ERROR]))
        after = torch.stack(move(before[:, 0], before[:, 1], course, distance), -1)
        was_inside, is_inside = self.edge.contains(torch.stack((before, after)), region).unbind(0)
        position = torch.where(was_inside, after, before)  # a lost vehicle stays where it was lost
        field = elements_at(self.field, position, region).float()
        target, weights = tensordict["target_field"].double(), tensordict["objective_weights"].double()
        objective = guidance.objective(field.double(), target, weights)
        values = {"field": field, "leg": action[:, :2].float(), "heading": heading.float().unsqueeze(-1)}
        return values | {"position": position, "objective": objective}, ~(was_inside & is_inside)

    def _arrival(self, tensordict: TensorDictBase, action: Tensor, moved: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return whether the rule of arrival ends episodes, and whether that is right there, ``(N, 1)`` each."""
        rules = self.scenario
        if rules.arrival == "objective":
            arrived = moved["objective"] < rules.zeta
        else:
            distance_km, _ = geodesic(*moved["position"].unbind(-1), *tensordict["target_position"].unbind(-1))
            arrived = distance_km.unsqueeze(-1) <= rules.radius_km
        return (action[:, 2:] > 0 if rules.declared else arrived), arrived

    def _recorded(self, tensordict: TensorDictBase, values: dict[str, Tensor]) -> TensorDict:
        """Return the state after a step, with the keys that a step leaves as they are, and keep it for pictures."""
        constant = {key: tensordict[key] for key in self._constant_keys}
        values["objective"] = values["objective"].float()
        after = TensorDict(constant | values, batch_size=tensordict.batch_size, device=self.device)
        self._tracks.add(after)
        return after

    def _rewards(self, before: Tensor, objective: Tensor, step: Tensor, arrived: Tensor) -> dict[str, Tensor]:
        """Return the reward and its terms, ``(N, 1)``, from the objective before and after a leg."""
        proximity = guidance.proximity_reward(before, objective, self.proximity_weight, self.objective_limit)
        proximity = guidance.late_decay(proximity, step, self.max_steps)
        destination = guidance.destination_reward(arrived, self.destination_weight)
        rewards = destination + proximity, destination, proximity
        return dict(zip(("reward", *specs.REWARD_TERMS), (x.float() for x in rewards), strict=True))

    # Rendering

    def track(self, vehicle: int) -> Tensor:
        """Return the positions of a vehicle in its running episode, start first: ``(T, 2)`` latitude, longitude [deg].

        Raises:
            RuntimeError: without ``render_mode="rgb_array"``, or before the first reset.
            ValueError: for a vehicle that is not in the batch.
        """
        return self._tracks.track(vehicle)

    def render(
        self, vehicles: Sequence[int] | None = None, *, size_px: int = 700, outlines: Sequence[Tensor] = ()
    ) -> np.ndarray:
        """Draw the running episodes over the field's contours.

        Args:
            vehicles: vehicles to draw; the first 16 by default.
            size_px: height and width [pixels].
            outlines: of areas to draw, each ``(P, 2)`` latitude, longitude [deg], as of
                :func:`magrl.transforms.areas.outlines`.

        Returns:
            ``(size_px, size_px, 3)`` uint8 RGB.

        Raises:
            RuntimeError, ValueError: as :meth:`track`, or for vehicles in several regions.
        """
        chosen = range(min(self.num_envs, 16)) if vehicles is None else vehicles
        paths = [self.track(vehicle).cpu() for vehicle in chosen]
        targets, region = (values[list(chosen)].cpu() for values in self._tracks.latest[2:])
        boxes = Regions.of(self.region[index] for index in region.unique().tolist())
        field = partial(copy.deepcopy(self.field).cpu(), index=region[0]) if len(self.region) > 1 else self.field
        return rgb_array(draw_tracks, size_px, field, boxes, paths, targets, [ring.cpu() for ring in outlines])

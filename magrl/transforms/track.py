"""The track of a vehicle in a TorchRL environment: what it knows of the field, its displacement and its next leg."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs.utils import make_composite_from_td

from magrl.checks import check_choice, check_type
from magrl.pilot import Reading, Rules, Track, advance, begin, declaring
from magrl.pilot.belief import LocalElements
from magrl.pilot.displacement import DestinationPosterior, Displacement
from magrl.pilot.observation import OBSERVATION_SIZE, TRACK_BOUNDS
from magrl.pilot.records import State
from magrl.pilot.step import observation
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.transforms.base import Keys, ObservationTransform, StatefulTransform, observed_spec, sorted_keys, with_state

READ_KEYS = ("field", "target_field", "leg", "heading", "elapsed_steps")
"""Keys that a track reads at each step."""
PLACE_KEYS = ("start_place", "target_place")
"""Keys of places that a vehicle knows; see :class:`KnownPlace`."""
KNOWN_KEYS = (*STD_KEYS, *PLACE_KEYS, "step_price")
"""Keys that it reads where an environment has them: the accuracy of readings, known places, a price."""


def reading_of(seen: TensorDictBase) -> Reading:
    """Return the reading of a TensorDict: :data:`READ_KEYS`, and the keys of :data:`KNOWN_KEYS` that it has.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> reading_of(GeomagneticNavEnv(num_envs=2, seed=0).reset()).distance
        tensor([0., 0.])
    """
    field, target, leg, heading, step = (seen[key] for key in READ_KEYS)
    std = SensorStd(*(seen.get(key, torch.zeros_like(field)).double() for key in STD_KEYS))
    price = seen.get("step_price", None)
    known = {
        "price": None if price is None else price.squeeze(-1),
        "place": seen.get("start_place", None),
        "target_place": seen.get("target_place", None),
    }
    return Reading(field, target, leg[..., 0], heading.squeeze(-1), std, step.squeeze(-1), **known)


def track_of(record: TensorDictBase) -> Track:
    """Return the track that :class:`TrackField` keeps under its first key."""
    parts = {"state": State, "posterior": DestinationPosterior, "displacement": Displacement, "local": LocalElements}
    return Track(*(parts[name](**record[name]) if name in parts else record[name] for name in Track._fields[:-1]))


class TrackField(StatefulTransform):
    """Keep the track of a vehicle by its own readings: the pilot of :mod:`magrl.pilot.step` as a transform.

    The nested key ``track`` has the state (float64, which a step reads from the TensorDict before it), the posterior of
    the displacement to the destination, its mean and covariance ``("track", "displacement", ...)`` [km], elements and
    gradients ``("track", "local", ...)``, the aim and the planned leg ``(..., 2)`` [km]. ``observation``, which may be
    left out, is what a network observes that corrects the plan. Nothing it writes is privileged unless an input is.

    Args:
        rules: what the vehicle knows before it starts.
        optional: keys of :data:`KNOWN_KEYS` that the environment has (:func:`known_keys`).
        in_keys: reading and target ``(..., 3)``, the last leg ``(..., K)`` (distance [km] first), heading ``(..., 1)``
            [rad], number of the step ``(..., 1)``, and the optional ones.
        out_keys: the track and the observation ``(..., 19)``.

    Raises:
        TypeError: for rules of another type.
        ValueError: for rules with integrity, which is of a vehicle on board.
        ValueError: for an optional key that is not known, or shapes that do not match.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), TrackField(Rules()))
        >>> env.rollout(5)["next", "track", "displacement", "mean"].shape
        torch.Size([2, 5, 2])
    """

    default_out_keys = ("track", "observation")
    optional_out_keys = ("observation",)
    bounds = TRACK_BOUNDS
    in_sizes = {"field": (3,), "target_field": (3,), "heading": (1,), "elapsed_steps": (1,)}

    def __init__(
        self,
        rules: Rules | None = None,
        optional: Sequence[str] = (),
        in_keys: Keys | None = None,
        **keys: Any,
    ) -> None:
        self.default_in_keys = _read_keys(optional)
        super().__init__(in_keys, **keys)
        rules = Rules() if rules is None else rules
        check_type(Rules, rules=rules)
        if rules.integrity:
            raise ValueError("rules with integrity True are of a vehicle on board alone: leave it out")
        self.rules = rules

    @property
    def state_keys(self) -> list[NestedKey]:
        """The state of the track."""
        return [(self.out_keys[0], "state", name) for name in State._fields]

    def _reading(self, values: Sequence[Tensor]) -> Reading:
        batch = values[0].shape[:-1]
        return reading_of(TensorDict(dict(zip(self.in_names, values, strict=True)), batch_size=batch))

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        reading = self._reading(values)
        self._write(tensordict, begin(self.rules, reading), reading)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        reading = self._reading(values)
        self._write(tensordict, advance(self.rules, State(*state), reading), reading)

    def _write(self, tensordict: TensorDictBase, track: Track, reading: Reading) -> None:
        tensordict.set(self.out_keys[0], _record(track, tensordict.batch_size))
        for key in self.out_keys[1:]:
            tensordict.set(key, observation(self.rules, track, reading))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the track and the observation."""
        observation_spec = super().transform_observation_spec(observation_spec)
        like = self._leaf(observation_spec, self.in_keys[0])
        leaves = _leaves(like.dtype).to(like.device).expand(like.shape[:-1])
        observation_spec[self.out_keys[0]] = make_composite_from_td(leaves, unsqueeze_null_shapes=False)
        for key in self.out_keys[1:]:
            self._add(observation_spec, like, key, OBSERVATION_SIZE)
        return observation_spec


@cache
def _leaves(dtype: torch.dtype) -> TensorDict:
    """Return the track of one vehicle that reads elements of a type."""
    one = torch.ones(1, 3, dtype=dtype)
    std, zero = SensorStd(*(0 * one.double() for _ in STD_KEYS)), one[:, 0]
    return _record(begin(Rules(), Reading(one, one, zero, zero, std, zero)), torch.Size([1]))[0]


def _record(track: Track, batch: torch.Size) -> TensorDict:
    """Return a track as a nested TensorDict."""
    kept = {key: value for key, value in track._asdict().items() if key != "goal"}
    parts = {key: value if isinstance(value, Tensor) else value._asdict() for key, value in kept.items()}
    return TensorDict(parts, batch_size=batch)


def _read_keys(optional: Sequence[str]) -> tuple[str, ...]:
    """Return the keys that a track reads, with the optional ones."""
    for key in optional:
        check_choice(KNOWN_KEYS, optional=key)
    return (*READ_KEYS, *optional)


def known_keys(observation_spec: Composite) -> list[str]:
    """Return the keys of :data:`KNOWN_KEYS` that an environment has.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> known_keys(GeomagneticNavEnv(seed=0).observation_spec)
        []
    """
    present = list(observation_spec.keys())
    return [key for key in KNOWN_KEYS if key in present]


class DeclareArrival(ObservationTransform):
    """Declare arrival from the track of a :class:`TrackField` before it, so that a policy writes two numbers.

    For an environment whose action has a third number that declares the arrival
    (:func:`magrl.pilot.declaring`). It also writes the probability that the vehicle is within the radius,
    ``arrival_probability`` ``(..., 1)``.

    Args:
        rules: of the track.
        optional: of the track.
        in_keys: of the track.

    Raises:
        ValueError: for an environment whose action has no third number.
        KeyError: for a missing key.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> base, rules = GeomagneticNavEnv(num_envs=2, arrival="declared", seed=0), Rules(arrival="declared")
        >>> TransformedEnv(base, Compose(TrackField(rules), DeclareArrival(rules))).action_spec.shape
        torch.Size([2, 2])
    """

    in_sizes = TrackField.in_sizes
    default_out_keys = ("arrival_probability",)
    out_sizes = {"arrival_probability": (1,)}
    invertible = True

    def __init__(self, rules: Rules, optional: Sequence[str] = (), in_keys: Keys | None = None) -> None:
        self.default_in_keys = _read_keys(optional)
        super().__init__(in_keys, in_keys_inv=["action"], out_keys_inv=["action"])
        check_type(Rules, rules=rules)
        self.rules = rules

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        posterior = DestinationPosterior(**next_tensordict["track", "posterior"])
        probability = posterior.within(self.rules.radius_km).unsqueeze(-1)
        return next_tensordict.set(self.out_keys[0], probability.to(next_tensordict[self.in_keys[0]].dtype))

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        *seen, action = self._read(tensordict, [*self.in_keys, *self.in_keys_inv])
        seen = TensorDict(dict(zip(self.in_names, seen, strict=True)), batch_size=action.shape[:-1])
        track = track_of(tensordict["track"])
        return tensordict.set(self.in_keys_inv[0], declaring(self.rules, track, reading_of(seen), action)[0])

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Leave the third number out of the action, and make what is read part of the state for other processes."""
        key, action = self.in_keys_inv[0], input_spec["full_action_spec"][self.in_keys_inv[0]]
        if action.shape[-1] != 3:
            raise ValueError(
                "DeclareArrival needs an environment whose action has a third number that declares the arrival, such "
                f"as GeomagneticNavEnv(arrival='declared'); {key!r} is {tuple(action.shape)}"
            )
        if self.parent is not None:
            observed = observed_spec(self)
            if "track" not in observed.keys():  # noqa: SIM118 - a Composite is no mapping
                keys = sorted_keys(observed)
                raise KeyError(f"DeclareArrival reads 'track', which is not among {keys}: add a TrackField")
            input_spec = with_state(input_spec, {name: observed[name] for name in (*self.in_keys, "track")})
        low, high = action.space.low[..., :2], action.space.high[..., :2]
        input_spec["full_action_spec"][key] = Bounded(low, high, low.shape, device=action.device, dtype=action.dtype)
        return input_spec

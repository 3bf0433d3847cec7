"""Observations of agents: scaled keys of a region, or estimates along the vehicle's own track."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec, Unbounded
from torchrl.envs import CatTensors, Transform

from magrl import tracking
from magrl.checks import check_number, check_numbers, check_tensor, check_type
from magrl.field import FieldBank, FieldModel, elements_range
from magrl.field.elements import NAMES, element_difference
from magrl.sensor_std import STD_KEYS
from magrl.tracking import STEP_PRICE
from magrl.transforms.base import Keys, ObservationTransform, StatefulTransform
from magrl.transforms.scaling import MinMaxNorm
from magrl.transforms.track import BELIEF_KEYS, IN_KEYS, PlannedMove, SearchAim, TrackField, turned

OBSERVATION_SIZE = 19
"""Numbers of :func:`track_observation`."""
_STD_UNITS = (1.0, 1.0, 100.0)
_LEAST_STD = 0.002
_LEAST_PRICE = 0.01


class AngleVector(ObservationTransform):
    """Write angles as cosine and sine, without a jump at the half turn.

    Args:
        in_keys: angles ``(..., 1)`` [rad].
        out_keys: vectors ``(..., 2)`` cosine, sine.

    Raises:
        ValueError: for keys that do not pair.

    Example:
        >>> from tensordict import TensorDict
        >>> AngleVector(["heading"], ["course"])(TensorDict(heading=torch.zeros(1)))["course"]
        tensor([1., 0.])
    """

    def __init__(self, in_keys: NestedKey | Keys, out_keys: NestedKey | Keys) -> None:
        super().__init__(in_keys, out_keys)
        if len(self.in_keys) != len(self.out_keys):
            raise ValueError(f"in_keys {self.in_keys} do not pair with out_keys {self.out_keys}")

        self.in_sizes = (1,) * len(self.in_keys)

    def _compute(self, values: list[Tensor]) -> list[Tensor]:
        return [torch.cat((torch.cos(angle), torch.sin(angle)), -1) for angle in values]

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add a box of [-1, 1] for each vector."""
        super().transform_observation_spec(observation_spec)
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            leaf = observation_spec[in_key]
            shape = (*leaf.shape[:-1], 2)
            observation_spec[out_key] = Bounded(-1.0, 1.0, shape, device=leaf.device, dtype=leaf.dtype)
        return observation_spec


class TargetDifference(ObservationTransform):
    """Write the difference between target values and present values.

    It is a linear map of values that are observed anyway, but a network need not learn it, and it can be scaled to the
    length of an episode instead of the size of a region.

    Args:
        in_keys: present values and target values, each ``(..., E)``.
        out_keys: target values minus present values ``(..., E)``.

    Raises:
        ValueError: for another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict(field=torch.tensor([8.0, -16.0]), target_field=torch.tensor([9.0, -20.0]))
        >>> TargetDifference()(td)["field_difference"]
        tensor([ 1., -4.])
    """

    default_in_keys = ("field", "target_field")
    default_out_keys = ("field_difference",)

    def _compute(self, values: list[Tensor]) -> list[Tensor]:
        return [values[1] - values[0]]

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the difference, bounded if both of its parts are."""
        value, target = (self._leaf(observation_spec, key) for key in self.in_keys)
        if value.shape != target.shape:
            raise ValueError(f"{self.in_keys} must have one shape, got {tuple(value.shape)} and {tuple(target.shape)}")
        spec: TensorSpec = Unbounded(value.shape, device=value.device, dtype=value.dtype)
        if isinstance(value, Bounded) and isinstance(target, Bounded):
            low, high = target.space.low - value.space.high, target.space.high - value.space.low
            spec = Bounded(low, high, value.shape, device=value.device, dtype=value.dtype)
        observation_spec[self.out_keys[0]] = spec
        return observation_spec


@dataclass(frozen=True, kw_only=True)
class _View:
    """Base class of views: the limits of actions and their scaling."""

    max_move_km: float
    max_turn_rad: float

    def __post_init__(self) -> None:
        check_number(0, above=True, max_move_km=self.max_move_km)
        check_number(0, math.pi, above=True, max_turn_rad=self.max_turn_rad)

    def action_transform(self, *, declared: bool = False) -> MinMaxNorm:
        """Return the transform from actions in [-1, 1] to distance [km] and turn [rad].

        Args:
            declared: whether actions have a third number, which declares the arrival and is in [-1, 1] anyway.

        Raises:
            TypeError: for ``declared`` that is not a bool.
        """
        check_type(bool, declared=declared)
        low, high = self._action_bounds()
        if declared:
            low, high = torch.cat((low, torch.tensor([-1.0]))), torch.cat((high, torch.tensor([1.0])))
        return MinMaxNorm(in_keys_inv=["action"], bounds={"action": (low, high)})

    def _action_bounds(self) -> tuple[Tensor, Tensor]:
        high = torch.tensor((self.max_move_km, self.max_turn_rad))
        return high * torch.tensor((0, -1)), high


@dataclass(frozen=True, kw_only=True)
class ObservationView(_View):
    """Keys that an agent observes, and their scaling; see :meth:`magrl.envs.GeomagneticNavEnv.observation_view`.

    Args:
        observe_heading: whether cosine and sine of the heading are observed. Without them the state is that of Eq. 3-1,
            from which a policy without memory cannot tell the direction of its next move.
        observe_difference: whether target elements minus measured elements are observed.
        field_low: D [deg], I [deg], B_H [nT] that are scaled to -1.
        field_high: D [deg], I [deg], B_H [nT] that are scaled to 1.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for bounds that are not finite or do not rise, a move or a turn out of range, or switches that are
            not bool.

    Example:
        >>> view = ObservationView(observe_heading=True, observe_difference=True, field_low=(8.0, -40.0, 33000.0),
        ...                        field_high=(12.0, -10.0, 37000.0), max_move_km=50.0, max_turn_rad=1.5)
        >>> view.size
        13
    """

    observe_heading: bool = True
    observe_difference: bool = True
    field_low: tuple[float, float, float]
    field_high: tuple[float, float, float]

    state_keys: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(3, field_low=self.field_low, field_high=self.field_high)
        if not all(low < high for low, high in zip(self.field_low, self.field_high, strict=True)):
            raise ValueError(f"field_low {self.field_low} must lie below field_high {self.field_high}")
        check_type(bool, observe_heading=self.observe_heading, observe_difference=self.observe_difference)

    @property
    def in_keys(self) -> tuple[str, ...]:
        """Keys of the environment that are observed."""
        return ("field", "target_field", "move", *(("heading",) if self.observe_heading else ()))

    @property
    def size(self) -> int:
        """Number of entries of ``observation``."""
        return 8 + 3 * self.observe_difference + 2 * self.observe_heading

    def observation_transforms(self) -> list[Transform]:
        """Return the transforms from the public keys to ``observation`` ``(..., size)``."""
        low, high = torch.tensor(self.field_low), torch.tensor(self.field_high)
        keys = ["field", "target_field", "move"]
        bounds = {"field": (low, high), "target_field": (low, high), "move": self._action_bounds()}
        steps: list[Transform] = []
        if self.observe_difference:
            # A quarter of the region's range is about the change over a path across half of it.
            bounds["field_difference"] = ((low - high) / 4, (high - low) / 4)
            keys.append("field_difference")
            steps.append(TargetDifference())
        scaled = [f"{key}_scaled" for key in keys]
        steps.append(MinMaxNorm(keys, scaled, bounds=bounds))
        if self.observe_heading:
            scaled.append("heading_vector")
            steps.append(AngleVector("heading", "heading_vector"))
        return [*steps, CatTensors(scaled, "observation", del_keys=False, sort=False)]

    @property
    def field_limits(self) -> tuple[list[float], list[float]]:
        """Lowest and highest elements at which the view is used: the scaled range and a quarter of it beyond.

        The margin is what a path across half of the region changes, and more than the field changes in some years.
        """
        ends = list(zip(self.field_low, self.field_high, strict=True))
        return [low - (high - low) / 4 for low, high in ends], [high + (high - low) / 4 for low, high in ends]

    def check_covers(self, field: FieldModel, position: Tensor) -> None:
        """Raise unless the elements of a field at some positions lie within :attr:`field_limits`.

        Args:
            field: field model to fly in.
            position: ``(..., 2)`` latitude, longitude [deg].

        Raises:
            ValueError: naming the element and both ranges; or for a bank of fields.
        """
        if isinstance(field, FieldBank):
            raise ValueError(f"the policy was trained in one region, this field has {len(field)}: fly it in one")
        ends = self.field_low, self.field_high, *(end.tolist() for end in elements_range(field, position))
        for name, unit, lowest, highest, least, most, low, high in zip(
            NAMES, ("°", "°", " nT"), *self.field_limits, *ends, strict=True
        ):
            if low < lowest or high > highest:
                raise ValueError(
                    f"the policy was trained where {name} is {least:.1f} to {most:.1f}{unit}; here it is {low:.1f} to "
                    f"{high:.1f}{unit}: train one for this region and date"
                )


def track_observation(seen: Mapping[Any, Tensor]) -> Tensor:
    """Return the observation of an agent that navigates by the estimates of its own track.

    All vectors are in the vehicle's frame, so that a policy generalizes over headings. Lengths are logarithms, because
    the best move depends on their ratios.

    Args:
        seen: ``aim``, the way to aim at, forward and to the right ``(..., 2)`` [km]; ``way_covariance``, that of the
            estimated way to the target ``(..., 2, 2)`` [km^2]; ``estimated_gradient``, forward and to the right
            ``(..., E, 2)`` [element unit / km]; ``remaining``, target elements minus estimated ones ``(..., E)``;
            ``weights`` of the objective F (Eq. 2-6), divided by the arrival threshold ``(..., E)``; ``sensor_std``,
            standard deviation of the noise of D [deg], I [deg], B_H [nT] ``(..., E)``; ``time``, the share of the step
            limit that is over ``(..., 1)``; ``planned_move``, the planned displacement, forward and to the right
            ``(..., 2)`` [km]; and ``step_price``, the price of a step ``(..., 1)`` [% of SPL].

    Returns:
        ``(..., 19)``: direction (2) and length (2) of the way; logarithms of its standard deviations (2) and their
        correlation; the same three of the arrival ellipse by the estimated gradient; logarithm of F over the threshold;
        time; logarithms of the noise (3); direction (2) and logarithm of the length of the plan; that of the price.

    Example:
        >>> seen = dict.fromkeys(("remaining", "weights", "sensor_std"), torch.ones(3))
        >>> seen |= {"aim": torch.tensor([30.0, 40.0]), "planned_move": torch.ones(2), "way_covariance": torch.eye(2)}
        >>> seen |= {"estimated_gradient": torch.ones(3, 2), "time": torch.ones(1), "step_price": torch.ones(1)}
        >>> track_observation(seen)[:2]
        tensor([0.6000, 0.8000])
    """
    way, gradient, weights, planned = (seen[key] for key in ("aim", "estimated_gradient", "weights", "planned_move"))
    check_tensor(2, aim=way)
    check_tensor(2, 2, way_covariance=seen["way_covariance"])
    length = way.norm(dim=-1, keepdim=True)
    ellipse = (weights[..., None, None] * gradient.unsqueeze(-1) * gradient.unsqueeze(-2)).sum(-3)
    objective = (weights * seen["remaining"].square()).sum(-1, keepdim=True)
    units = torch.tensor(_STD_UNITS, dtype=way.dtype, device=way.device)
    std, std_correlation = _axes(seen["way_covariance"], least=1e-6)
    axes, axes_correlation = _axes(ellipse, least=1e-12)
    planned_km = planned.norm(dim=-1, keepdim=True)
    return torch.cat(
        (
            way / length.clamp_min(1e-3),
            torch.log1p(length / 20) - 2,
            length.clamp(max=2500) / 400 - 0.5,
            torch.log(std / 20) / 2,
            std_correlation,
            torch.log(axes * 20) / 2,
            axes_correlation,
            torch.log(objective + 1e-2) / 3 - 0.5,
            seen["time"],
            torch.log((seen["sensor_std"] / units).clamp_min(_LEAST_STD)) / 2 + 2,
            planned / planned_km.clamp_min(1e-3),
            torch.log1p(planned_km / 20) - 1,
            torch.log(seen["step_price"].clamp_min(_LEAST_PRICE) * 10) / 2,
        ),
        -1,
    )


def _axes(matrix: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Return the roots of the diagonal ``(..., 2)`` and the correlation ``(..., 1)`` of symmetric matrices."""
    roots = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(least).sqrt()
    return roots, (matrix[..., 0, 1] / roots.prod(-1)).unsqueeze(-1)


class TrackObservation(StatefulTransform):
    """Write the observation of an agent that navigates by its own track, see :func:`track_observation`.

    It stands after :class:`~magrl.transforms.TrackField`, :class:`~magrl.transforms.SearchAim` and
    :class:`~magrl.transforms.PlannedMove`; without the second, ``in_keys={"aim": "way"}``. The
    weights of the objective follow from the first reading, which is kept as state in the TensorDict.

    Args:
        in_keys: reading and target ``(..., 3)``, heading ``(..., 1)`` [rad], estimated field ``(..., 3)``, its gradient
            ``(..., 3, 2)``, way to aim at ``(..., 2)``, covariance of the mean way ``(..., 2, 2)``, standard deviation
            of the noise ``(..., 3)``, number of the step ``(..., 1)``, and planned displacement ``(..., 2)`` [km].
        out_keys: observation ``(..., 19)`` and the first reading ``(..., 3)``.
        zeta: arrival threshold on the objective.
        max_steps: step limit.
        step_price: price of a step [% of SPL]; None where vehicles have their own, at ``step_price`` ``(..., 1)``.

    Raises:
        ValueError: for an option out of its range, or another number of keys.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import SensorNoise
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> estimates = TrackField(std_keys=STD_KEYS), SearchAim(zeta=0.01)
        >>> plan = PlannedMove(max_move_km=50.0, max_steps=50)
        >>> observation = TrackObservation(zeta=0.01, max_steps=50)
        >>> steps = Compose(SensorNoise((0.05, 0.05, 5.0)), *estimates, plan, observation)
        >>> TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)["observation"].shape
        torch.Size([2, 3, 19])
    """

    default_in_keys = (
        *("field", "target_field", "heading", "estimated_field", "estimated_gradient", "aim", "way_covariance"),
        *("sensor_std", "elapsed_steps", "planned_move"),
    )
    default_out_keys = ("observation", "first_field")
    optional_in_keys = ("step_price",)
    out_sizes = (OBSERVATION_SIZE,), (3,)

    def __init__(self, *, zeta: float, max_steps: int, step_price: float | None = STEP_PRICE, **keys: Any) -> None:
        super().__init__(optional=["step_price"] if step_price is None else (), **keys)
        check_number(0, above=True, zeta=zeta)
        check_number(1, whole=True, max_steps=max_steps)
        check_number(0, above=True, optional=True, step_price=step_price)
        self.zeta, self.max_steps, self.step_price = zeta, max_steps, step_price

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        self._advance(tensordict, values, values[:1])

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        (first,), seen = state, self._named(values)
        target, heading = seen["target_field"], seen["heading"]
        for key in ("aim", "planned_move"):
            seen[key] = turned(seen[key].unsqueeze(-2), heading).squeeze(-2)
        seen["estimated_gradient"] = turned(seen["estimated_gradient"], heading)
        seen["way_covariance"] = turned(turned(seen["way_covariance"], heading).mT, heading)
        if self.step_price is not None:
            seen["step_price"] = torch.full_like(heading, self.step_price)
        seen["remaining"] = element_difference(target, seen["estimated_field"])
        seen["weights"] = tracking.arrival_weights(first, target, self.zeta)
        # A policy may fly longer than it was trained for.
        seen["time"] = (seen["elapsed_steps"].to(heading.dtype) / self.max_steps).clamp(max=1)
        observed = track_observation(seen)
        tensordict.set(self.out_keys[0], observed).set(self.out_keys[1], first)


@dataclass(frozen=True, kw_only=True)
class TrackView(_View):
    """Describe what an agent without a map observes: the estimates along its own track, and a plan.

    Args:
        zeta: arrival threshold.
        max_steps: step limit.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        range_km: prior standard deviation of the way along each axis [km].
        search: whether it observes the way to where the vehicle has not been (:class:`~magrl.transforms.SearchAim`), as
            suits environments that end the episode at arrival.
        radius_km: distance from the destination at which the episode ends [km]; None where the objective ends it.
        step_price: price of a step [% of SPL]; a higher price gives fewer steps and a longer path. None where
            the agent observes it as ``step_price``, for training.
        caution: weight of the uncertainty of the way in the plan.
        crust_nt: standard deviation of the field of the crust in each axis [nT].

    Raises:
        ValueError: for a number out of its range.
        TypeError: for ``search`` other than a bool.

    Example:
        >>> TrackView(zeta=0.01, max_steps=50, max_move_km=50.0, max_turn_rad=1.5).size
        19
    """

    zeta: float
    max_steps: int
    range_km: float = tracking.RANGE_KM
    search: bool = True
    radius_km: float | None = None
    step_price: float | None = STEP_PRICE
    caution: float = tracking.CAUTION
    crust_nt: float = 0.0

    size: ClassVar[int] = OBSERVATION_SIZE
    in_keys: ClassVar[tuple[str, ...]] = (*IN_KEYS, "elapsed_steps")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number(0, above=True, zeta=self.zeta, range_km=self.range_km)
        check_number(0, caution=self.caution, crust_nt=self.crust_nt)
        check_number(1, whole=True, max_steps=self.max_steps)
        check_type(bool, search=self.search)
        check_number(0, above=True, optional=True, step_price=self.step_price, radius_km=self.radius_km)

    @property
    def state_keys(self) -> tuple[str, ...]:
        """Keys of the state that a step reads from the one before."""
        return *BELIEF_KEYS, "first_field", *(("visited", "arrival_weights") if self.search else ())

    def observation_transforms(self, *, tracked: bool = False) -> list[Transform]:
        """Return the transforms from the public keys and standard deviations to ``observation`` ``(..., 19)``.

        Args:
            tracked: whether the environment has the first of them, :class:`~magrl.transforms.TrackField`.
        """
        world: dict[str, Any] = {"range_km": self.range_km, "crust_nt": self.crust_nt}
        track = [] if tracked else [TrackField(std_keys=STD_KEYS, **world)]
        search = [SearchAim(zeta=self.zeta, radius_km=self.radius_km)] if self.search else []
        aim = "aim" if self.search else "way"
        options: dict[str, Any] = {"max_steps": self.max_steps, "step_price": self.step_price}
        plan: dict[str, Any] = {"max_move_km": self.max_move_km, "caution": self.caution, **world}
        return [
            *track,
            *search,
            PlannedMove(in_keys={"way": aim}, **plan, **options),
            TrackObservation(in_keys={"aim": aim}, zeta=self.zeta, **options),
        ]

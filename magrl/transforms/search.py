"""Transform that aims at the most probable destination where a vehicle has not been."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from magrl import guidance, tracking
from magrl.checks import check_number
from magrl.field.elements import element_difference
from magrl.tracking import FieldTrack, Way
from magrl.transforms.base import (
    Keys,
    ObservationTransform,
    expect_keys,
    observed_spec,
    several_keys,
    sorted_keys,
    with_state,
)
from magrl.transforms.track import FRAMES


class SearchAim(ObservationTransform):
    """Write the way to the most probable destination that the vehicle has not visited.

    The episode has not ended where the vehicle was, so the destination is not there: see
    :func:`magrl.tracking.unvisited`. This matters where the readings have a constant error, since the estimate alone
    then leads to a place beside the destination, and stays there. For environments that end the episode at arrival; a
    vehicle that must declare its arrival does not know that it has not arrived.

    It stands after :class:`~magrl.transforms.TrackGradient`. Its state is in the TensorDict.

    Args:
        in_keys: reading and target ``(..., 3)``, last move ``(..., K)`` (distance [km] first), heading ``(..., 1)``
            [rad], mean ``(..., 3, 3)`` and covariance ``(..., 3, 3, 3)`` of the filter, estimated way ``(..., 2)`` [km]
            and its covariance ``(..., 2, 2)`` [km^2].
        out_keys: the way to aim at ``(..., 2)`` [km], and the state: displacements to the last visited
            places ``(..., 24, 2)`` northward and eastward [km], and weights of the objective ``(..., 3)``.
        zeta: arrival threshold on the objective.
        frame: axes of the way, as in :class:`~magrl.transforms.TrackGradient`.

    Raises:
        ValueError: for a threshold that is not above 0, an unknown frame, or another number of keys.
        KeyError: for a step from a TensorDict without the state.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import TrackGradient
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> steps = Compose(TrackGradient(), SearchAim(zeta=0.01))
        >>> TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)["visited"].shape
        torch.Size([2, 3, 24, 2])
    """

    def __init__(
        self,
        in_keys: Keys = (
            "field",
            "target_field",
            "move",
            "heading",
            "track_mean",
            "track_covariance",
            "way",
            "way_covariance",
        ),
        out_keys: Keys = ("aim", "visited", "arrival_weights"),
        *,
        zeta: float,
        frame: str = "world",
    ) -> None:
        super().__init__(in_keys=several_keys(in_keys), out_keys=several_keys(out_keys))
        expect_keys(self, 8, 3)
        check_number(0, above=True, zeta=zeta)
        if frame not in FRAMES:
            raise ValueError(f"frame must be one of {FRAMES}, got {frame!r}")
        self.zeta, self.frame = float(zeta), frame

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._start(tensordict_reset)

    def _start(self, first: TensorDictBase) -> TensorDictBase:
        values = self._read(first)
        if values is None:
            return first
        floors = values[0].new_tensor(guidance.OBJECTIVE_FLOORS)
        difference = element_difference(values[1], values[0])
        weights = guidance.objective_weights(torch.zeros_like(difference), difference, floors) / self.zeta
        return self._write(first, values, tracking.unvisited_yet(values[0]), weights)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is None:
            return next_tensordict
        visited, weights = (tensordict.get(key, None) for key in self.out_keys[1:])
        if visited is None or weights is None:
            raise KeyError(
                f"SearchAim reads its state {self.out_keys[1:]}, which a reset writes: step from what reset() or "
                f"step_mdp() returned; got {sorted_keys(tensordict)}"
            )
        _, _, move, heading, *_ = values
        leg = move[..., :1] * torch.cat((torch.cos(heading), torch.sin(heading)), -1)
        return self._write(next_tensordict, values, tracking.visit(visited, leg), weights)

    def _write(
        self, tensordict: TensorDictBase, values: list[Tensor], visited: Tensor, weights: Tensor
    ) -> TensorDictBase:
        _, _, _, heading, mean, covariance, way, spread = values
        ellipse = tracking.arrival_ellipse(FieldTrack(mean, covariance), weights)
        if self.frame == "world":
            aim = tracking.unvisited(Way(way, spread), visited, ellipse)
        else:
            cos, sin = torch.cos(heading), torch.sin(heading)
            ahead = torch.stack((torch.cat((cos, sin), -1), torch.cat((-sin, cos), -1)), -2)  # rows: forward, right
            ellipse = ahead @ ellipse @ ahead.mT
            aim = tracking.unvisited(Way(way, spread), visited @ ahead.mT, ellipse)
        for key, value in zip(self.out_keys, (aim, visited, weights), strict=True):
            tensordict.set(key, value)
        return tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begin at a first reading; on transitions, compute the step from the state at the root."""
        if tensordict.get("next", None) is None:
            return self._start(tensordict)
        self._step(tensordict, tensordict["next"])
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the state, unbounded."""
        leaf = self._leaf(observation_spec, self.in_keys[0])
        for key, size in zip(self.out_keys, self._sizes(), strict=True):
            spec = Unbounded((*leaf.shape[:-1], *size), device=leaf.device, dtype=leaf.dtype)
            observation_spec[key] = spec
        return observation_spec

    @staticmethod
    def _sizes() -> tuple[tuple[int, ...], ...]:
        """Return the last dimensions of what is written."""
        return (2,), (tracking.VISITED, 2), (3,)

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Make the state part of the input, so that batched and parallel environments pass it to the next step."""
        observed = self.transform_observation_spec(observed_spec(self).clone())
        return with_state(super().transform_input_spec(input_spec), {key: observed[key] for key in self.out_keys[1:]})

"""Map matching: a navigator with a map of the field, on which it estimates its position and that of the destination."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from magrl import geodesy, tracking
from magrl.checks import check_number, check_numbers, check_type
from magrl.envs import GeomagneticNavEnv, Region, Regions, Scenario
from magrl.envs.regions import check_expansions
from magrl.field import Date, FieldBank, FieldModel, RegionalField, elements_at, igrf_coefficients, parse_date
from magrl.field.elements import element_difference, elements_gradient, measured_elements
from magrl.field.model import device_of
from magrl.geodesy import steer
from magrl.navigators.base import Navigator, displacement_to
from magrl.navigators.quasi_newton import first_places, search_options, visit_place
from magrl.sensor_std import PERFECT, SensorStd
from magrl.tracking import SLOPES, Way

FLOOR = (1e-3, 1e-3, 0.1)
"""Minimum standard deviation of readings of D, I [deg], B_H [nT]: rounding of the reading and of the map."""
SECULAR_VARIATION = (0.1, 0.1, 39.0)
"""Root mean square change per year of D, I [deg], B_H [nT] in regions of the Earth, 2015 to 2025 (IGRF-14)."""
GRID_POINTS = 41
"""Points of the grid along each side of the region, on which the inversion of the map starts."""
NEWTON_STEPS = 8
LONGEST_STEP_KM = 200.0
PRIOR_KM = 1000.0
"""Prior standard deviation of a position along each axis [km]."""
FORGET_KM = 30.0
"""Distance over which the position variance grows by that of the map's error [km]; from a scan."""
BIAS_SHARE = 0.25
"""Share of the variance of the bias that counts as noise of each reading."""
_DEGREE_KM = 111.2


class MapMatching(Navigator):
    """Map matching: an extended Kalman filter of the vehicle's position, by readings that are compared with a map.

    The first reading is inverted on the map: from the lowest points of its error on a grid of the region, Gauss-Newton
    steps lead to a few hypotheses of the position. Each is then tracked by its own filter: moves are dead-reckoned, and
    each reading corrects the position and adds its normalized squared residual to the misfit of the hypothesis. The
    destination is found on the same map by its elements. Each move follows the geodesic to it from the hypothesis of
    the least misfit.

    An error of the map, for example its age, moves both positions nearly alike, so that much of it cancels. With
    ``map_error``, the filter also forgets: the older a reading, the less it tells of the error at the present place.

    It needs the region; with several regions, the key ``region`` names the vehicle's.

    Args:
        field: the map, a field model or a bank of them; ``env.field`` is a perfect one.
        region: where vehicle and destination may be, usually ``env.edge``; the map must hold all of it.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        sensor_std: accuracy of the sensors; three numbers are white noise of D [deg], I [deg], B_H [nT].
        map_error: standard deviations of the map.
        hypotheses: number of positions that are tracked.
        zeta: arrival threshold on the objective, see :func:`~magrl.tracking.arrival_weights`.
        search: whether the episode ends at arrival, so that the destination is not where the vehicle has been.
        radius_km: distance from the destination at which the episode ends [km]; None where the objective ends it.

    Raises:
        TypeError: for a region of another type.
        ValueError: for an option out of its range, a bank with another number of expansions than regions, or a map that
            is not defined on all of the region.

    Source:
        L. D. Hostetler and R. D. Andreas, Nonlinear Kalman filtering techniques for terrain-aided navigation, IEEE
        Trans. Automatic Control 28 (1983): parallel filters over a map, and the least residual chooses among them.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> rollout = env.rollout(50, MapMatching(env.field, env.edge), break_when_any_done=False)
        >>> rollout["next", "success"].any(1).flatten()
        tensor([True, True])
    """

    name, label = "map_matching", "map matching"
    description = "map matching (Kalman filter)"
    needs = "a map and the region"
    options = ("map_date",)

    def __init__(
        self,
        field: FieldModel | FieldBank,
        region: Region | Regions,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        sensor_std: SensorStd | Sequence[float] = PERFECT,
        map_error: Sequence[float] = PERFECT.noise,
        hypotheses: int = 4,
        zeta: float = 0.01,
        search: bool = False,
        radius_km: float | None = None,
    ) -> None:
        super().__init__(max_move_km, max_turn_rad)
        check_number(0, above=True, optional=True, radius_km=radius_km)
        if not hasattr(field, "value_and_gradient"):
            raise ValueError(f"field must have value_and_gradient(latitude, longitude), got {field!r}")
        check_type((Region, Regions), region=region)
        check_numbers(3, 0, map_error=map_error)
        check_number(1, GRID_POINTS**2, whole=True, hypotheses=hypotheses)
        check_number(0, above=True, zeta=zeta)
        check_type(bool, search=search)
        self.hypotheses, bank = int(hypotheses), isinstance(field, FieldBank)
        self.zeta, self.search, self.radius_km = float(zeta), search, radius_km
        self.in_keys = ["field", "target_field", "heading", "move", "elapsed_steps", *(["region"] if bank else [])]
        self.map = field
        self._place(copy.deepcopy(Regions.of(region)).to(device_of(field)))
        std = torch.tensor((FLOOR, map_error, *SensorStd.of(sensor_std)), dtype=torch.float64)
        floor, error, noise, bias, drift, iron = std.to(self.grid.device).square()
        self.magnetic = bool(bias[0].isinf())
        self.target_std = nn.Buffer(torch.where(bias < math.inf, floor + error, math.inf).sqrt())
        variances = SensorStd(floor + error + noise + BIAS_SHARE * bias, floor + bias, drift, iron)
        self.sensor_std = nn.Buffer(torch.stack(variances).sqrt())
        # Two elements give a position, so that the second smallest of the three counts.
        self.map_error_km = sorted(std / slope for std, slope in zip(map_error, SLOPES, strict=True))[1]

    @classmethod
    def for_env(cls, env: GeomagneticNavEnv, *, map_date: Date | None = None, **options: Any) -> Self:
        """Return the navigator of an environment, with its field as the map, or IGRF at ``map_date``.

        With a map of another date it does not search: most errors of the map displace vehicle and destination alike.
        """
        if map_date is not None:
            field = dated_map(env.scenario, map_date, env.max_move_km).to(env.device)
            options = {"field": field, "map_error": aged_error(env.scenario, map_date), "search": False} | options
        return super().for_env(env, **options)

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: SensorStd) -> dict[str, Any]:
        shared = {"sensor_std": sensor_std, "zeta": env.zeta, **search_options(env)}
        return {"field": env.field, "region": env.edge, **shared}

    def _place(self, region: Regions) -> None:
        """Keep the region, and the elements on a grid of it."""
        check_expansions(self.map, region)
        grid = region.grid(GRID_POINTS)
        index = torch.arange(len(region), device=grid.device).reshape(-1, 1, 1)
        elements = elements_at(self.map, grid, index)
        missing = ~elements.isfinite().flatten(1).all(1)
        if missing.any():
            box = region[int(missing.nonzero()[0])]
            raise ValueError(f"the map is not defined on all of {box}: take a map of a larger box, or a smaller region")
        self.grid = nn.Buffer(grid.flatten(1, 2))
        self.grid_elements = nn.Buffer(elements)
        self.box = nn.Buffer(torch.stack((region.latitude, region.longitude), -1))

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        position = self.grid.new_zeros(len(seen["heading"]), self.hypotheses, 2)
        covariance, misfit = torch.diag_embed(position), position[..., 0].clone()
        located = torch.zeros_like(position[:, 0, 0], dtype=torch.bool)
        hypotheses = {"position": position, "covariance": covariance, "misfit": misfit}
        return {**hypotheses, "target": position[:, 0].clone(), "known": located} | first_places(seen, self.zeta)

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        located = memory["known"].clone()
        for rows, read in ((~located, self._begin), (located, self._track)):
            if rows.any():
                memory[rows] = read(seen[rows], memory[rows])
        visit_place(seen, memory)
        here, there = best(memory["position"], memory["misfit"]), memory["target"]
        distance, bearing = geodesy.geodesic(*here.unbind(-1), *there.unbind(-1))
        if self.search:
            way = torch.stack((distance * torch.cos(bearing), distance * torch.sin(bearing)), -1)
            distance, bearing = geodesy.polar(self._unvisited(way, here, seen, memory))
        heading = self._true_heading(seen, here.unsqueeze(1)).squeeze(-1)
        return steer(heading, bearing, distance, self.max_move_km, self.max_turn_rad)

    def _true_heading(self, seen: TensorDictBase, position: Tensor) -> Tensor:
        """Return the heading from true north ``(P, H)`` [rad] at positions ``(P, H, 2)``, by the map's D."""
        heading = seen["heading"].double().expand(position.shape[:-1])
        if not self.magnetic:
            return heading
        index = self._region(seen).unsqueeze(-1).expand(position.shape[:-1])
        return heading + torch.deg2rad(elements_at(self.map, position, index)[..., 0])

    def _unvisited(self, way: Tensor, here: Tensor, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:
        """Return the way ``(P, 2)`` [km] to the most probable destination where the vehicle has not been.

        A constant error of the readings moves the vehicle on the map, and not the destination.
        """
        region, elements = self._region(seen), seen["field"].double()
        std = SensorStd(*self.sensor_std).at(seen).bias
        residual, jacobian = self._residual(here.unsqueeze(1), elements, std, region)
        prior = torch.diag_embed(torch.full_like(here, PRIOR_KM**2)).unsqueeze(1)
        constant = update(prior, jacobian, residual)[1].squeeze(1)
        covariance = best(memory["covariance"], memory["misfit"]) + constant
        gradient = (jacobian.squeeze(1) * std.unsqueeze(-1)).nan_to_num(0.0)  # D, where its error has no limit
        nothing = torch.zeros(2, 2).to(gradient)  # the map states no error of its gradient
        ellipse = tracking.arrival_ellipse(gradient, nothing, memory["weights"], self.radius_km)
        return tracking.unvisited(Way(way, covariance), memory["visited"], ellipse)

    def _begin(self, seen: TensorDictBase, memory: TensorDictBase) -> TensorDictBase:
        """Find the vehicle by its first reading, and the destination by its elements."""
        region = self._region(seen)
        target, _, misfit = self._located(seen["target_field"].double(), self.target_std, region)
        memory["target"] = best(target, misfit)
        hypotheses = self._located(seen["field"].double(), self.sensor_std[0], region)
        memory["known"] = torch.ones_like(memory["known"])
        return memory.update(dict(zip(("position", "covariance", "misfit"), hypotheses, strict=True)))

    def _track(self, seen: TensorDictBase, memory: TensorDictBase) -> TensorDictBase:
        """Dead-reckon the last move of each hypothesis, and correct it by the reading at its end."""
        region, length = self._region(seen), seen["move"][:, :1].double()
        heading = self._true_heading(seen, memory["position"])
        position = self._moved(memory["position"], heading, length, region)
        growth = self.map_error_km**2 * length / FORGET_KM
        covariance = memory["covariance"] + torch.diag_embed(growth.unsqueeze(-1).expand_as(position))
        std = SensorStd(*self.sensor_std).at(seen).noise
        position, covariance, more = self._corrected(position, covariance, seen["field"].double(), std, region)
        return memory.update({"position": position, "covariance": covariance, "misfit": memory["misfit"] + more})

    def _located(self, elements: Tensor, std: Tensor, region: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Invert the map: positions ``(P, H, 2)`` for elements ``(P, 3)``, their covariances and misfits."""
        position = self._lowest(elements, std, region)
        for _ in range(NEWTON_STEPS):
            residual, jacobian = self._residual(position, elements, std, region)
            length, heading = geodesy.polar(displacement_to(residual, jacobian))
            position = self._moved(position, heading, length.clamp_max(LONGEST_STEP_KM), region)
        prior = torch.diag_embed(torch.full_like(position, PRIOR_KM**2))
        return self._corrected(position, prior, elements, std, region)

    def _lowest(self, elements: Tensor, std: Tensor, region: Tensor) -> Tensor:
        """Return the points of the grid ``(P, H, 2)`` where the error is lowest, lowest first.

        The error is divided by its standard deviation, and by the change of the elements from point to point.
        """
        side = (self.box[region, 1, 0] - self.box[region, 0, 0]) * _DEGREE_KM / (GRID_POINTS - 1)
        spread = torch.hypot(std, side.unsqueeze(-1) * std.new_tensor(SLOPES))[:, None, None]
        away = element_difference(elements[:, None, None], self.grid_elements[region]) / spread
        height = away.square().sum(-1).flatten(1)
        rows = height.topk(self.hypotheses, largest=False).indices
        return self.grid[region].gather(1, rows.unsqueeze(-1).expand(-1, -1, 2))

    def _corrected(
        self, position: Tensor, covariance: Tensor, elements: Tensor, std: Tensor, region: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions, covariances and misfits after a reading ``(P, 3)`` of each vehicle."""
        residual, jacobian = self._residual(position, elements, std, region)
        displacement, covariance, misfit = update(covariance, jacobian, residual)
        length, heading = geodesy.polar(displacement)
        return self._moved(position, heading, length, region), covariance, misfit

    def _residual(self, position: Tensor, elements: Tensor, std: Tensor, region: Tensor) -> tuple[Tensor, Tensor]:
        """Return elements minus those of the map ``(P, H, 3)`` and its gradient ``(P, H, 3, 2)``, both over ``std``."""
        index = (region.unsqueeze(-1).expand(position.shape[:-1]),) if isinstance(self.map, FieldBank) else ()
        value, gradient = self.map.value_and_gradient(*position.unbind(-1), *index)
        residual = element_difference(elements.unsqueeze(1), measured_elements(value))
        std = std.expand(len(position), 3).unsqueeze(1)
        return residual / std, elements_gradient(value, gradient) / std.unsqueeze(-1)

    def _moved(self, position: Tensor, heading: Tensor, distance_km: Tensor, region: Tensor) -> Tensor:
        """Return positions ``(P, H, 2)`` after moves, held within the region, where the map is defined."""
        latitude, longitude = geodesy.move(position[..., 0], position[..., 1], heading, distance_km)
        low, high = self.box[region].unsqueeze(1).unbind(-2)
        middle = (low[..., 1] + high[..., 1]) / 2
        longitude = middle + geodesy.wrap_longitude(longitude - middle)
        return torch.stack((latitude, longitude), -1).clamp(low, high)

    def _region(self, seen: TensorDictBase) -> Tensor:
        """Return the number of the region of each vehicle ``(P,)``."""
        return seen.get("region", torch.zeros_like(seen["elapsed_steps"])).squeeze(-1)


def update(covariance: Tensor, jacobian: Tensor, residual: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Correct positions by readings: the update of an extended Kalman filter, in Joseph's form.

    Args:
        covariance: ``(..., 2, 2)`` of a position [km^2].
        jacobian: ``(..., E, 2)`` gradients of the elements, over their standard deviations [1/km].
        residual: ``(..., E)`` readings minus the elements at the position, over their standard deviations.

    Returns:
        Displacement ``(..., 2)`` [km], covariance ``(..., 2, 2)`` after the reading, and misfit ``(...)``, the square
        of the residual over its covariance.

    Example:
        >>> way, covariance, misfit = update(torch.eye(2), torch.eye(2), torch.tensor([2.0, 0.0]))
        >>> way, covariance.diagonal(), misfit
        (tensor([1., 0.]), tensor([0.5000, 0.5000]), tensor(2.))
    """
    gradient, sides = jacobian @ covariance, residual.unsqueeze(-1)
    innovation = gradient @ jacobian.mT + torch.eye(residual.shape[-1], dtype=residual.dtype, device=residual.device)
    solved, _ = torch.linalg.solve_ex(innovation, torch.cat((gradient, sides), -1))
    gain = solved[..., :2].mT
    complement = torch.eye(2, dtype=gain.dtype, device=gain.device) - gain @ jacobian
    misfit = (residual * solved[..., 2]).sum(-1)
    return (gain @ sides).squeeze(-1), complement @ covariance @ complement.mT + gain @ gain.mT, misfit


def best(position: Tensor, misfit: Tensor) -> Tensor:
    """Return the hypothesis of the least misfit: ``(P, ...)`` of ``(P, H, ...)``.

    Example:
        >>> best(torch.tensor([[[0.0, 1.0], [2.0, 3.0]]]), torch.tensor([[5.0, 1.0]]))
        tensor([[2., 3.]])
    """
    return position[torch.arange(len(position), device=position.device), misfit.argmin(-1)]


def dated_map(scenario: Scenario, date: Date, max_move_km: float = 50.0) -> RegionalField | FieldBank:
    """Return IGRF at another date, over every place that a vehicle can reach in a scenario.

    Args:
        scenario: region or regions, generation of IGRF, and altitude.
        date: date of the map.
        max_move_km: longest move [km].

    Raises:
        ValueError: for a date outside the field model, or a region where the field of that date has no smooth elements.

    Example:
        >>> dated_map(Scenario(), "2015-01-01").latitude
        (-15.5, 5.5)
    """
    scenario = scenario.replace(tasks=None, names=(), max_move_km=max_move_km)
    if not isinstance(scenario.field, FieldBank):
        dated = scenario.replace(date=date, field=None).build_field()
        assert isinstance(dated, RegionalField)
        return dated
    box, gauss = scenario.reachable(), igrf_coefficients(date, scenario.generation).unsqueeze(0)
    planet = torch.zeros(len(box), dtype=torch.int64)
    return FieldBank.build(gauss, planet, box.latitude, box.longitude, degree=scenario.field.degree, tolerance_nt=0.1)


def aged_error(scenario: Scenario, date: Date) -> tuple[float, float, float]:
    """Return the standard deviations of D, I [deg], B_H [nT] that a map of another date has in a scenario.

    Example:
        >>> [round(std) for std in aged_error(Scenario(date="2025-01-01", generation=14), "2015-01-01")]
        [1, 1, 390]
    """
    years = abs((parse_date(scenario.date) - parse_date(date)).days) / 365.25
    d, i, b_h = SECULAR_VARIATION
    return years * d, years * i, years * b_h

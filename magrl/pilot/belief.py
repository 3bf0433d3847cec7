"""What a vehicle knows of the field around it: one normal distribution, and how legs and readings change it.

The state has the local coefficients of the field's potential to degree 3 (:mod:`~magrl.pilot.harmonics`, the first
three are the field itself), a magnetic anomaly, the error of the estimated place, the drift of dead reckoning, and the
errors of the readings: constant ones of D, I, B_H, and a field that turns with the vehicle, such as by hard iron. The
anomaly is the field of the crust and of magnetic weather, three components that vary along the path as a first-order
Gauss-Markov process. Where the place is not known, its error northward is the error of the latitude, which is
dead-reckoned (true north turns along the path, by tan(latitude) / R for each kilometer eastward). Where it is known,
and with it a model of the Earth, the coefficients stay those at the true place, and a leg changes them as the model
does, but for their difference from it (:class:`Motion`). Both steps are a Kalman filter's:

- A leg along a great circle is linear in the coefficients, c' = Turn(gamma) exp(X) c, where X = n (d_x + T_N / M) + e
  (d_y + T_E / N) has the generators of translations, with the degrees above 3 as their regression, and of the turns of
  the vertical over the radii of curvature M and N. Gamma is by how much azimuths become larger along the great circle.
- A reading measures the field: D, I, B_H are a vector in the local axes, and their errors are carried over to it by
  the Jacobian at the reading. So nothing is linearized but errors.

A vehicle that has no north reference but its compass measures I and B_H, and its headings are from magnetic north. Its
axes are from magnetic north where it is: the field has no eastward part there, exactly. They are turned after each
leg by how much D has changed along it, as the belief expects; the latitude is not known (NaN) and not needed.

All functions batch over leading dimensions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from magrl.field.elements import elements_jacobian, field_vector, measured_elements
from magrl.geodesy import move_place
from magrl.pilot.earth import EarthModel
from magrl.pilot.harmonics import UNIT_KM, arc, generators, turning
from magrl.pilot.local import COEFFICIENTS, carry, closed_derivatives, inverse3, radii, slopes
from magrl.pilot.prior import ANGLES, DEGREE, closure, expected, lasting_covariances, latitude_cells
from magrl.sensor_std import PERFECT, SensorStd

PLACE = slice(COEFFICIENTS, COEFFICIENTS + 2)
"""True minus estimated place, northward and eastward [km] in the state."""
DRIFT = slice(COEFFICIENTS + 2, COEFFICIENTS + 4)
"""Constant drift of dead reckoning, northward and eastward [share of the distance] in the state."""
CONSTANT = slice(COEFFICIENTS + 4, COEFFICIENTS + 7)
"""Constant errors of D, I [deg], B_H [nT] in the state."""
ANOMALY = slice(COEFFICIENTS + 7, COEFFICIENTS + 10)
"""Anomaly of the field: north, east, down [nT] in the state."""
IRON = slice(COEFFICIENTS + 10, COEFFICIENTS + 13)
"""Errors that turn with the vehicle, such as hard iron: forward, to the right and downward [nT] in the state."""
STATES = COEFFICIENTS + 13
"""Number of states."""
ANOMALY_KM = 125.0
"""Correlation length of the anomaly [km]. WMMHR, degrees 14 to 133 at the ground, has .9 at 50 km, .62 at 100 km and
.28 at 150 km; for a ship, it is four hours of magnetic weather."""
LONGER_KM = 250.0
"""The same for integrity: with a shorter one, anomalies average out too soon, and arrivals are too sure [km]."""
MODEL_NT = 2.0
"""Standard deviation of the field by what the model leaves out, in each axis [nT]: .1 to .8 after six legs of 50 km on
random planets, and more after many."""


class Motion(NamedTuple):
    """How dead reckoning and the field go on from place to place.

    Args:
        model: model of the Earth; None without one.
        drift: constant drift of dead reckoning, standard deviation along each axis as a share of the displacement.
        wander_km: random part of it, standard deviation along each axis after a distance of 1 km [km].
        anomaly_km: correlation length of anomalies [km].
        drift_km: ``(...)`` distance over which it drifts in a leg [km]; None for the length of the leg.
    """

    model: EarthModel | None = None
    drift: float = 0.0
    wander_km: float = 0.0
    anomaly_km: float = ANOMALY_KM
    drift_km: Tensor | None = None


STILL = Motion()


class Belief(NamedTuple):
    """Mean ``(..., S)`` and covariance ``(..., S, S)`` of the state, and the estimated place ``(..., 2)``, latitude and
    longitude [deg]. Latitude is NaN in the axes of magnetic north; longitude is NaN where the place is not known, and
    latitude then the reference of the error northward.

    Example:
        >>> belief = start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd(torch.tensor([0.05, 0.05, 5.0])))
        >>> belief.mean.shape, round(float(belief.latitude))
        (torch.Size([28]), 40)
    """

    mean: Tensor
    covariance: Tensor
    place: Tensor

    @property
    def latitude(self) -> Tensor:
        """Latitude ``(...)`` [deg]."""
        return self.place[..., 0]

    @property
    def located(self) -> Tensor:
        """Whether the place is known ``(...)``."""
        return ~self.place[..., 1].isnan()

    @property
    def field(self) -> Tensor:
        """Expected field ``(..., 3)`` north, east, down [nT]."""
        return self.mean[..., :3]

    @property
    def magnetic(self) -> Tensor:
        """Whether the axes are from magnetic north ``(...)``."""
        return self.latitude.isnan()

    @property
    def measured(self) -> Tensor:
        """Whether a reading measures D, I, B_H ``(..., 3)``."""
        north = ~self.magnetic
        return torch.stack((north, torch.ones_like(north), torch.ones_like(north)), -1)


class Innovation(NamedTuple):
    """A reading minus its prediction: residual ``(..., 3)`` of D, I [deg], B_H [nT], the derivatives ``(..., 3, S)`` of
    the prediction with respect to the state, and the residual's covariance ``(..., 3, 3)``. An element that is missing
    has a residual of 0, rows of 0 and a variance of 1.

    Example:
        >>> Innovation(torch.zeros(3), torch.zeros(3, 28), torch.eye(3)).square()
        tensor(0.)
    """

    residual: Tensor
    rows: Tensor
    covariance: Tensor

    def noisy(self, sensor_std: Tensor) -> Innovation:
        """Return it with a noise of standard deviations ``(..., 3)``; a missing element has 1."""
        variance = torch.where((self.rows == 0).all(-1), 1.0, sensor_std.double()).square()
        return self._replace(covariance=self.covariance + torch.diag_embed(variance))

    def square(self) -> Tensor:
        """Return the normalized square ``(...)``: where the belief is right, chi-square of the elements present."""
        return (self.residual.unsqueeze(-2) @ inverse3(self.covariance) @ self.residual.unsqueeze(-1)).squeeze((-2, -1))


def start(reading: Tensor, errors: SensorStd, heading: Tensor | None = None) -> Belief:
    """Return the belief after a first reading.

    Args:
        reading: ``(..., 3)``: D [deg], I [deg], B_H [nT].
        errors: accuracy of the readings, tensors ``(..., 3)``.
        heading: ``(...)`` [rad, clockwise from true north]; None without errors that turn with the vehicle.

    Example:
        >>> start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd(torch.zeros(3))).covariance.shape
        torch.Size([28, 28])
    """
    return read(before(reading, errors), reading, torch.as_tensor(errors.noise), heading)


def before(near: Tensor, errors: SensorStd, model: EarthModel | None = None) -> Belief:
    """Return the belief before any reading, where the elements are about ``near``; other arguments as :func:`start`.

    Where the constant error of D has no limit (infinite), the vehicle has no true north, and D does not count.

    Where the start's true elements are known: ``read(known(before(elements, errors), elements, std), reading, ...)``.

    Args:
        near: ``(..., 3)``: D [deg], I [deg], B_H [nT].
        errors: accuracy of the readings, tensors ``(..., 3)``.
        model: model of the Earth, whose places are the prior; the spectrum of random planets without one.

    Example:
        >>> before(torch.tensor([3.0, 65.0, 18000.0]), PERFECT).mean.shape
        torch.Size([28])
    """
    near, magnetic = near.double(), torch.as_tensor(errors.bias)[..., 0].isinf().expand(near.shape[:-1])
    mean, covariance = expected(field_vector(near), latitude_cells() if model is None else model.cells())
    if torch.compiler.is_compiling() or magnetic.any():  # its table is large
        north = torch.where(magnetic.unsqueeze(-1), near * near.new_tensor((0.0, 1.0, 1.0)), near)
        cells = latitude_cells(ANGLES) if model is None else model.cells(magnetic=True)
        unknown = expected(field_vector(north), cells)
        mean, covariance = (
            torch.where(magnetic.reshape(*magnetic.shape, *[1] * n), new, old)
            for n, new, old in zip((1, 2), (unknown[0], _without(unknown[1], 1)), (mean, covariance), strict=True)
        )
    latitude = torch.rad2deg(mean[..., -1:]).masked_fill(magnetic.unsqueeze(-1), math.nan)
    scale = torch.ones_like(mean)
    scale[..., -1] = torch.where(magnetic, 1.0, radii(latitude[..., 0])[0])  # radians of latitude to kilometers
    covariance = covariance * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    place = torch.cat((latitude, torch.full_like(latitude, math.nan)), -1)
    return _with_errors(mean[..., :-1], covariance, place, errors)


def at_place(place: Tensor, place_km: float, errors: SensorStd, motion: Motion) -> Belief:
    """Return the belief before any reading at a place that is known, by a model of the Earth.

    Args:
        place: ``(..., 2)`` latitude, longitude [deg].
        place_km: its root mean square error [km].
        errors: accuracy of the readings, tensors ``(..., 3)``.
        motion: with a model.
    """
    assert motion.model is not None
    place = place.double()
    mean = motion.model.coefficients(place)
    jacobian = slopes(mean, place)
    lever = torch.cat((jacobian, torch.eye(2).to(jacobian).expand(*jacobian.shape[:-2], 2, 2)), -2)
    covariance = lever @ lever.mT * (place_km**2 / 2)
    covariance = covariance + pad(motion.model.error.to(mean), (0, 2, 0, 2))
    drift = torch.eye(2).to(mean) * motion.drift**2
    joint = pad(covariance, (0, 2, 0, 2)) + pad(drift, (DRIFT.start, 0, DRIFT.start, 0))
    return _with_errors(mean, joint, place, errors)


def _with_errors(mean: Tensor, covariance: Tensor, place: Tensor, errors: SensorStd) -> Belief:
    """Return a belief whose first states have a mean and a covariance, and the others the sensors'."""
    constant, anomaly, iron = (
        kind.expand(*mean.shape[:-1], 3, 3) for kind in lasting_covariances(mean[..., :3], errors)
    )
    variances = sum(
        pad(kind, (part.start, STATES - part.stop) * 2)
        for kind, part in zip((constant, anomaly, iron), (CONSTANT, ANOMALY, IRON), strict=True)
    )
    rest = STATES - covariance.shape[-1]
    return Belief(pad(mean, (0, STATES - mean.shape[-1])), pad(covariance, (0, rest, 0, rest)) + variances, place)


def moved(
    belief: Belief,
    distance: Tensor,
    course: Tensor,
    errors: SensorStd = PERFECT,
    motion: Motion = STILL,
    crust_nt: Tensor | float = 0.0,
) -> Belief:
    """Return the belief after a leg, before the reading at its end.

    Args:
        belief: that before the leg.
        distance: ``(...)`` [km], to about 200; divide longer legs.
        course: ``(...)`` at the start of the leg [rad, clockwise from north].
        errors: accuracy of the readings, tensors ``(..., 3)``.
        motion: errors of dead reckoning, and the model of the Earth, where the place is known.
        crust_nt: ``(...)`` standard deviation of the crust's field in each axis [nT].

    Example:
        >>> belief = start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd(torch.tensor([0.05, 0.05, 5.0])))
        >>> further = moved(belief, torch.tensor(50.0), torch.tensor(0.0))
        >>> (further.field - belief.field).round()  # northward by 50 km
        tensor([-157.,   -0.,  267.], dtype=torch.float64)
    """
    distance, course = distance.double(), course.double()
    latitude = torch.deg2rad(belief.latitude)
    sin, cos = torch.sin(latitude), torch.cos(latitude)
    north, east = distance * torch.cos(course), distance * torch.sin(course)
    middle = belief.latitude + torch.rad2deg(north / radii(belief.latitude)[0]) / 2
    meridian, vertical = radii(middle)
    angles = north / meridian, east / vertical
    turn = arc(sin, cos, *angles)
    matrix = turning(turn.cos_turn, turn.sin_turn, DEGREE) @ carry(north / UNIT_KM, east / UNIT_KM, *angles)
    column = matrix @ belief.mean[..., :COEFFICIENTS, None]
    column = (turn.slope / meridian)[..., None, None] * (generators(DEGREE).turn[2].to(column) @ column)
    rise = turn.sin * cos - turn.cos * sin  # sine of the change of the latitude
    after = belief.latitude + torch.rad2deg(rise * (1 + rise * rise / 6))
    kept, ones = torch.exp(-distance / motion.anomaly_km).unsqueeze(-1), torch.ones_like(belief.mean)
    step = torch.cat((0 * ones[..., :COEFFICIENTS], ones[..., COEFFICIENTS:]), -1)
    step[..., COEFFICIENTS], step[..., ANOMALY] = turn.rate, kept.expand_as(step[..., ANOMALY])
    step = torch.diag_embed(step)
    rest = STATES - COEFFICIENTS
    step = step + pad(torch.cat((matrix.expand(*column.shape[:-1], COEFFICIENTS), column), -1), (0, rest - 1, 0, rest))
    spread = pad(closure().drift.to(step), (0, rest, 0, rest)) * (distance / UNIT_KM).square()[..., None, None]
    fresh = (1 - kept.square()).unsqueeze(-1) * lasting_covariances(belief.field, errors, crust_nt)[1]
    fresh = pad(fresh, (ANOMALY.start, STATES - ANOMALY.stop) * 2)
    mean = (step @ belief.mean.unsqueeze(-1)).squeeze(-1)
    place = torch.stack((after, belief.place[..., 1]), -1)
    if motion.model is not None:
        return _moved_by_model(belief, Belief(mean, fresh, place), matrix, spread, distance, course, motion)
    further = Belief(mean, step @ belief.covariance @ step.mT + spread + fresh, place)
    return _to_magnetic_north(further) if torch.compiler.is_compiling() or belief.magnetic.any() else further


def _moved_by_model(
    belief: Belief, after: Belief, matrix: Tensor, spread: Tensor, distance: Tensor, course: Tensor, motion: Motion
) -> Belief:
    """Return the belief after a leg where the place is known: coefficients change as the model's do at the
    estimated place, and their difference from the model as any field does.

    With the model's coefficients m and their slopes J before the leg, m' and J' after it, the turn and translation M,
    and the errors d of the place, c' = m' + M (c - m - J d) + J' d'.
    """
    model = motion.model
    assert model is not None
    here, start = slice(None, COEFFICIENTS), belief.place
    end = move_place(start, course, distance)
    (old, slope), (new, slope_end) = (
        (c, slopes(c, place)) for place in (start, end) for c in (model.coefficients(place),)
    )
    turn = distance * torch.tan(torch.deg2rad(end[..., 0])) / radii(end[..., 0])[1]  # of north, eastward of the place
    none, sin, cos = torch.zeros_like(turn), torch.sin(course), torch.cos(course)
    carried = torch.stack((none + 1, none, turn * sin, 1 - turn * cos), -1).unflatten(-1, (2, 2))
    ones = torch.ones_like(belief.mean)
    step = torch.diag_embed(torch.cat((0 * ones[..., : PLACE.stop], ones[..., PLACE.stop :]), -1))
    kept = torch.exp(-distance / motion.anomaly_km)[..., None, None]
    step[..., ANOMALY, ANOMALY] = step[..., ANOMALY, ANOMALY] * kept
    step[..., here, here] = matrix
    step[..., here, PLACE], step[..., PLACE, PLACE] = slope_end @ carried - matrix @ slope, carried
    far = (distance if motion.drift_km is None else motion.drift_km)[..., None, None]
    step[..., here, DRIFT], step[..., PLACE, DRIFT] = slope_end * far, torch.eye(2).to(step) * far
    mean = (step @ belief.mean.unsqueeze(-1)).squeeze(-1)
    mean[..., here] = mean[..., here] + new - (matrix @ old.unsqueeze(-1)).squeeze(-1)
    lever = torch.cat((slope_end, torch.eye(2).to(slope_end).expand(*slope_end.shape[:-2], 2, 2)), -2)
    wander = pad(lever @ lever.mT, (0, STATES - PLACE.stop) * 2) * (motion.wander_km**2 * far)
    covariance = step @ belief.covariance @ step.mT + spread * model.share + after.covariance + wander
    return Belief(mean, covariance, end)


def settled(belief: Belief) -> Belief:
    """Return a belief whose expected error of the place is taken into the place, where that is known."""
    north, east = belief.mean[..., PLACE].where(belief.located.unsqueeze(-1), 0.0).unbind(-1)
    known = belief.located.unsqueeze(-1)
    place = torch.where(known, belief.place, 0.0)
    moved_place = move_place(place, torch.atan2(east, north), torch.hypot(north, east))
    mean = belief.mean.clone()
    mean[..., PLACE] = torch.where(known, 0.0, mean[..., PLACE])
    return Belief(mean, belief.covariance, torch.where(known, moved_place, belief.place))


def _to_magnetic_north(belief: Belief) -> Belief:
    """Return a belief with its axes turned to magnetic north, where they are such; D there depends on the state."""
    x, y = (
        torch.where(belief.magnetic, part, other)
        for part, other in zip(belief.mean[..., :2].unbind(-1), (1.0, 0.0), strict=True)
    )
    level = torch.hypot(x, y)
    turn = turning(x / level, -y / level, DEGREE)
    mean = (turn @ belief.mean[..., :COEFFICIENTS, None]).squeeze(-1)
    per_eastward = (generators(DEGREE).turn[2].to(mean) @ mean.unsqueeze(-1)) / level[..., None, None]
    slope = torch.where(belief.magnetic[..., None, None], turn - per_eastward * turn[..., 1:2, :], turn)
    rest = belief.mean.shape[-1] - COEFFICIENTS
    step = pad(slope, (0, rest, 0, rest))
    step = step + torch.diag_embed(pad(torch.zeros_like(mean), (0, rest), value=1.0))
    mean = torch.cat((mean, belief.mean[..., COEFFICIENTS:]), -1)
    return Belief(mean, step @ belief.covariance @ step.mT, belief.place)


def innovation(
    belief: Belief, reading: Tensor, sensor_std: Tensor, heading: Tensor | None = None, errors: bool = True
) -> Innovation:
    """Return the innovation of a reading: residual y - H x, rows H, and covariance S = H P H^T + R.

    x and P are mean and covariance of the belief. y is the vector of the field that was read, times the Jacobian of D,
    I, B_H there, which is also the part of H for the field. R is the variance of the reading's noise, and of what the
    model leaves out (:data:`MODEL_NT`). Arguments are those of :func:`read`.

    Args:
        belief: that before the reading.
        reading: ``(..., 3)``.
        sensor_std: ``(..., 3)``.
        heading: ``(...)`` [rad].
        errors: whether the reading has the errors of the state; the true elements of a known place have not.

    Example:
        >>> belief = start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd(torch.tensor([0.05, 0.05, 5.0])))
        >>> reading, std = torch.tensor([3.5, 65.0, 18000.0]), torch.tensor([0.05, 0.05, 5.0])
        >>> innovation(belief, reading, std).residual.round(decimals=1)
        tensor([0.5000, -0.0000, 0.7000], dtype=torch.float64)
    """
    return predicted(belief, reading, sensor_std < math.inf, heading, errors).noisy(sensor_std)


def predicted(
    belief: Belief, reading: Tensor, read: Tensor, heading: Tensor | None = None, errors: bool = True
) -> Innovation:
    """Return an :func:`innovation` without the noise of the reading, where some elements ``(..., 3)`` are read."""
    reading = reading.double()
    present = read & (reading == reading) & belief.measured
    vector = field_vector(torch.where(present, reading, _elements(belief.field)))
    jacobian = torch.where(present.unsqueeze(-1), elements_jacobian(vector), 0.0)
    rows = pad(jacobian, (0, COEFFICIENTS - 3))
    if errors:
        own = torch.diag_embed(present.double()).expand_as(jacobian)
        course = torch.zeros_like(reading[..., 0]) if heading is None else heading
        turn = turning(torch.cos(course.double()), torch.sin(course.double()), 1)  # forward, right, down
        place = torch.zeros_like(rows[..., :4])
        rows = torch.cat((rows[..., :COEFFICIENTS], place, own, jacobian, jacobian @ turn), -1)
    rows = pad(rows, (0, belief.mean.shape[-1] - rows.shape[-1]))
    residual = (jacobian @ vector.unsqueeze(-1) - rows @ belief.mean.unsqueeze(-1)).squeeze(-1)  # y - H x
    return Innovation(residual, rows, rows @ belief.covariance @ rows.mT + MODEL_NT**2 * jacobian @ jacobian.mT)


def updated(belief: Belief, new: Innovation) -> Belief:
    """Return the belief given an innovation: mean x + K r and covariance P - K H P.

    Example:
        >>> belief = before(torch.tensor([3.0, 65.0, 18000.0]), PERFECT)
        >>> updated(belief, innovation(belief, torch.tensor([4.0, 65.0, 18000.0]), torch.ones(3))).mean.shape
        torch.Size([28])
    """
    cross = belief.covariance @ new.rows.mT
    gain = cross @ inverse3(new.covariance)
    mean = belief.mean + (gain @ new.residual.unsqueeze(-1)).squeeze(-1)
    covariance = belief.covariance - gain @ cross.mT
    return Belief(mean, (covariance + covariance.mT) / 2, belief.place)  # else, what is not symmetric grows


def read(belief: Belief, reading: Tensor, sensor_std: Tensor, heading: Tensor | None = None) -> Belief:
    """Return the belief after a reading.

    Args:
        belief: that before the reading.
        reading: ``(..., 3)``: D [deg], I [deg], B_H [nT]; NaN for an element that is missing.
        sensor_std: ``(..., 3)`` standard deviation of the errors that are new in it; infinite for a missing element.
        heading: ``(...)`` [rad, clockwise from true north] of the vehicle, where the state has iron.

    Example:
        >>> belief = before(torch.tensor([3.0, 65.0, 18000.0]), PERFECT)
        >>> read(belief, torch.tensor([3.0, 65.0, 18000.0]), torch.tensor([0.05, 0.05, 5.0])).field.round()
        tensor([17975.,   942., 38601.], dtype=torch.float64)
    """
    return settled(updated(belief, innovation(belief, reading, sensor_std, heading)))


def known(belief: Belief, elements: Tensor, std: Tensor, crust_nt: Tensor | float = 0.0) -> Belief:
    """Return the belief given the true elements of the place, which have none of the errors of a reading.

    Args:
        belief: that before.
        elements: ``(..., 3)``: D [deg], I [deg], B_H [nT], of a map or a pier.
        std: ``(..., 3)`` their standard deviation.
        crust_nt: ``(...)`` the same of the crust's field in each axis [nT], where the map has none.

    Example:
        >>> here = torch.tensor([3.0, 65.0, 18000.0])
        >>> belief = known(before(here, SensorStd(bias=torch.ones(3))), here, torch.full((3,), 0.01))
        >>> belief = read(belief, here + torch.tensor([0.8, 0.0, 0.0]), torch.full((3,), 0.01))
        >>> belief.mean[CONSTANT].round(decimals=1)  # the compass is off by 0.8 degrees
        tensor([0.8000, -0.0000, 0.2000], dtype=torch.float64)
    """
    new = innovation(belief, elements, std, errors=False)
    crust = torch.as_tensor(crust_nt)[..., None, None].square() * new.rows[..., :3] @ new.rows[..., :3].mT
    return updated(belief, new._replace(covariance=new.covariance + crust))


class LocalElements(NamedTuple):
    """D, I [deg], B_H [nT] at the vehicle ``(..., 3)``, their gradients ``(..., 3, 2)`` northward and eastward
    [per km], and for each element the covariance ``(..., 3, 3, 3)`` of its value and gradient.

    Example:
        >>> elements(start(torch.tensor([3.0, 65.0, 18000.0]), PERFECT)).gradient.shape
        torch.Size([3, 2])
    """

    value: Tensor
    gradient: Tensor
    covariance: Tensor


def elements(belief: Belief) -> LocalElements:
    """Return the expected elements at the vehicle, their gradients, and how sure they are.

    From magnetic north, D is 0 everywhere.

    Example:
        >>> here = elements(start(torch.tensor([0.0, 60.0, 20000.0]), SensorStd(torch.tensor([0.05, 0.05, 5.0]))))
        >>> (100 * here.gradient).round(decimals=1)  # change over 100 km
        tensor([[ 0.0000e+00, -2.0000e-01],
                [ 8.0000e-01,  0.0000e+00],
                [-2.8030e+02,  0.0000e+00]], dtype=torch.float64)
    """
    mean, derivative = belief.mean[..., :COEFFICIENTS], closed_derivatives().to(belief.mean)
    turn, latitude = generators(DEGREE).turn.to(mean), torch.deg2rad(belief.latitude)
    meridian, vertical = (radius.unsqueeze(-1).unsqueeze(-1) for radius in radii(belief.latitude))
    latitude = torch.where(belief.magnetic, 0.0, latitude)
    sin, cos = (wave(latitude)[..., None, None] for wave in (torch.sin, torch.cos))
    north = derivative[0, :3] / UNIT_KM + turn[0, :3] / meridian
    east = derivative[1, :3] / UNIT_KM + turn[1, :3] / vertical + sin / (cos * vertical) * turn[2, :3]
    field = torch.eye(3, COEFFICIENTS).to(mean).expand_as(north)
    rows = elements_jacobian(belief.field).unsqueeze(-3) @ torch.stack((field, north, east), -3)  # (..., 3, E, K)
    column = (
        elements_jacobian(belief.field)
        @ turn[2, :3, :3]
        @ belief.field.unsqueeze(-1)
        / (cos.square() * vertical * meridian)
    )
    column = torch.stack((0 * column, 0 * column, column), -3)
    rows = torch.cat((rows, column), -1).transpose(-3, -2)  # (..., E, 3, K + 1): value, northward, eastward
    state = COEFFICIENTS + 1
    rows = rows.where(belief.measured[..., None, None], 0.0)
    slopes = (rows[..., 1:, :] @ belief.mean[..., None, :state, None]).squeeze(-1)
    covariance = rows @ belief.covariance[..., None, :state, :state] @ rows.mT
    return LocalElements(_elements(belief.field), slopes, covariance)


def _without(covariance: Tensor, index: int) -> Tensor:
    """Return a covariance given the value of one entry."""
    column = covariance[..., index]
    return covariance - column.unsqueeze(-1) * column.unsqueeze(-2) / column[..., index, None, None]


def _elements(field: Tensor) -> Tensor:
    """Return D, I, B_H of a field, in the single precision with which the pretrained agent was trained."""
    return measured_elements(field.float()).to(field)

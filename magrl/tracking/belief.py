"""What a vehicle knows of the field around it: one normal distribution, and how moves and readings change it.

The state has the local coefficients of the field's potential to degree 3 (:mod:`~magrl.tracking.harmonics`, the first
three are the field itself), the offset of the latitude from a reference that is dead-reckoned (true north turns along
the way, by tan(latitude) / R for each kilometer eastward), and the errors of the readings of D, I, B_H: constant ones,
slow ones, which vary along the way as a first-order Gauss-Markov process, and a field that turns with the vehicle,
such as that of hard iron. Both steps are those of a Kalman filter:

- A move along a great circle is linear in the coefficients, c' = Turn(gamma) exp(X) c, where X = n (d_x + T_N / M) + e
  (d_y + T_E / N) has the generators of translations, with the degrees above 3 as their regression, and of the turns of
  the vertical over the radii of curvature M and N. Gamma is by how much azimuths become larger along the great circle.
- A reading measures the field: D, I, B_H are a vector in the local axes, and their errors are carried over to it by
  the Jacobian at the reading. So nothing is linearized but errors.

A vehicle that has no north reference but its compass measures I and B_H, and its headings are from magnetic north. Its
axes are those of magnetic north where it is: the field has no eastward part there, exactly. They are turned after each
move by how much D has changed along it, as the belief expects; the latitude is not known (NaN) and not needed.

All functions batch over leading dimensions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from magrl.checks import check_tensor
from magrl.field.elements import elements_jacobian, field_vector, measured_elements
from magrl.geodesy import curvature_radii
from magrl.sensor_std import PERFECT, SensorStd
from magrl.tracking.harmonics import RADIUS, UNIT_KM, arc, generators, size, turning
from magrl.tracking.prior import ANGLES, DEGREE, closure, expected

COEFFICIENTS = size(DEGREE)
"""Number of coefficients of a belief; the latitude's offset [rad] has this index in the state."""
CONSTANT = slice(COEFFICIENTS + 1, COEFFICIENTS + 4)
"""Constant errors of D, I [deg], B_H [nT] in the state."""
SLOW = slice(COEFFICIENTS + 4, COEFFICIENTS + 7)
"""Slow errors of D, I [deg], B_H [nT] in the state."""
IRON = slice(COEFFICIENTS + 7, COEFFICIENTS + 10)
"""Errors that turn with the vehicle, such as hard iron: forward, to the right and downward [nT] in the state."""
STATES = COEFFICIENTS + 10
"""Number of states."""
LASTING_KM = 30.0
"""Correlation length of slow errors [km]: for a ship, an hour of magnetic weather; chosen on random planets, under the
conditions of four vehicles."""
MODEL_NT = 2.0
"""Standard deviation of the field by what the model leaves out, in each axis [nT]: .1 to .8 after six moves of 50 km on
random planets, and more after many."""


class Belief(NamedTuple):
    """Mean ``(..., S)`` and covariance ``(..., S, S)`` of the state, and the reference latitude ``(...)`` [deg]: NaN in
    the axes of magnetic north.

    Example:
        >>> belief = start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd(torch.tensor([0.05, 0.05, 5.0])))
        >>> belief.mean.shape, round(float(belief.latitude))
        (torch.Size([25]), 40)
    """

    mean: Tensor
    covariance: Tensor
    latitude: Tensor

    @property
    def field(self) -> Tensor:
        """Expected field ``(..., 3)`` north, east, down [nT]."""
        return self.mean[..., :3]

    @property
    def magnetic(self) -> Tensor:
        """Whether the axes are those of magnetic north ``(...)``."""
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
        >>> Innovation(torch.zeros(3), torch.zeros(3, 25), torch.eye(3)).square()
        tensor(0.)
    """

    residual: Tensor
    rows: Tensor
    covariance: Tensor

    def square(self) -> Tensor:
        """Return the normalized square ``(...)``: where the belief is right, chi-square of the elements present."""
        return (self.residual.unsqueeze(-2) @ inverse3(self.covariance) @ self.residual.unsqueeze(-1)).squeeze((-2, -1))


def start(reading: Tensor, errors: SensorStd, heading: Tensor | None = None, crust_nt: float = 0.0) -> Belief:
    """Return the belief after a first reading.

    Args:
        reading: ``(..., 3)``: D [deg], I [deg], B_H [nT].
        errors: accuracy of the readings, tensors ``(..., 3)``.
        heading: ``(...)`` [rad, clockwise from true north]; None without errors that turn with the vehicle.
        crust_nt: standard deviation of the crust's field in each axis [nT].

    Example:
        >>> start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd(torch.zeros(3))).covariance.shape
        torch.Size([25, 25])
    """
    return read(before(reading, errors), reading, torch.as_tensor(errors.noise), heading, crust_nt)


def before(near: Tensor, errors: SensorStd) -> Belief:
    """Return the belief before any reading, where the elements are about ``near``; other arguments as :func:`start`.

    Where the constant error of D has no limit (infinite), the vehicle has no true north, and D does not count.

    Where the start's true elements are known: ``read(known(before(elements, errors), elements, std), reading, ...)``.

    Example:
        >>> before(torch.tensor([3.0, 65.0, 18000.0]), PERFECT).mean.shape
        torch.Size([25])
    """
    check_tensor(3, near=near)
    near, magnetic = near.double(), torch.as_tensor(errors.bias)[..., 0].isinf().expand(near.shape[:-1])
    mean, covariance = expected(field_vector(near))
    if torch.compiler.is_compiling() or torch.compiler.is_exporting() or magnetic.any():  # its table is large
        north = torch.where(magnetic.unsqueeze(-1), near * near.new_tensor((0.0, 1.0, 1.0)), near)
        unknown = expected(field_vector(north), ANGLES)
        mean, covariance = (
            torch.where(magnetic.reshape(*magnetic.shape, *[1] * n), new, old)
            for n, new, old in zip((1, 2), (unknown[0], _without(unknown[1], 1)), (mean, covariance), strict=True)
        )
    constant, slow, iron = (kind.expand(*near.shape, 3) for kind in lasting_covariances(mean[..., :3], errors))
    count = STATES - COEFFICIENTS - 1
    variances = sum(
        pad(kind, (part.start, STATES - part.stop) * 2)
        for kind, part in zip((constant, slow, iron), (CONSTANT, SLOW, IRON), strict=True)
    )
    latitude = torch.rad2deg(mean[..., -1]).masked_fill(magnetic, math.nan)
    return Belief(pad(mean[..., :-1], (0, count + 1)), pad(covariance, (0, count, 0, count)) + variances, latitude)


def lasting_covariances(field: Tensor, errors: SensorStd) -> tuple[Tensor, Tensor, Tensor]:
    """Return the covariances ``(..., 3, 3)`` of constant and slow errors of D, I [deg], B_H [nT], and of iron along
    the vehicle's axes [nT^2].

    The stated drift contains the effect of the iron on the elements, as a mean over the headings. Slow errors of the
    field vector, such as magnetic weather, have a part along magnetic north, which changes B_H by that and I by -sin(I)
    of it over the total intensity, and a downward part, which changes I by cos(I) of it over the same. Where both have
    the same size, the correlation of I and B_H is -sin(I).

    Args:
        field: ``(..., 3)`` north, east, down [nT].
        errors: accuracy of the readings, tensors ``(..., 3)``.

    Example:
        >>> errors = SensorStd(bias=torch.tensor([0.5, 0.0, 0.0]), drift=torch.tensor([0.3, 0.0, 0.0]))
        >>> lasting_covariances(torch.tensor([20000.0, 0.0, 30000.0]), errors)[0].diagonal()
        tensor([0.1600, 0.0000, 0.0000], dtype=torch.float64)
    """
    bias, drift, iron = (torch.as_tensor(std).to(field.device, torch.float64).square() for std in errors[1:])
    bias = torch.where(bias < math.inf, bias, 0.0)  # that of D, which is then no reading
    level = iron[..., :2].mean(-1)
    axes = torch.stack((level, level, iron[..., 2]), -1)
    spread = elements_jacobian(field.double()).square() @ axes.unsqueeze(-1)
    slow = torch.diag_embed((drift - spread.squeeze(-1)).clamp_min(0))
    sin = field[..., 2].double() / field.double().norm(dim=-1)
    shared = -sin * (slow[..., 1, 1] * slow[..., 2, 2]).sqrt()
    slow[..., 1, 2], slow[..., 2, 1] = shared, shared
    return torch.diag_embed((bias - drift).clamp_min(0)), slow, torch.diag_embed(iron)


def moved(belief: Belief, distance: Tensor, course: Tensor, errors: SensorStd = PERFECT) -> Belief:
    """Return the belief after a move, before the reading at its end.

    Args:
        belief: that before the move.
        distance: ``(...)`` [km], to about 200; divide longer moves.
        course: ``(...)`` at the start of the move [rad, clockwise from north].
        errors: accuracy of the readings, tensors ``(..., 3)``.

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
    matrix = turning(turn.cos_turn, turn.sin_turn, DEGREE) @ _carry(north / UNIT_KM, east / UNIT_KM, *angles)
    column = matrix @ belief.mean[..., :COEFFICIENTS, None]
    column = turn.slope[..., None, None] * (generators(DEGREE).turn[2].to(column) @ column)
    rise = turn.sin * cos - turn.cos * sin  # sine of the change of the latitude
    after = belief.latitude + torch.rad2deg(rise * (1 + rise * rise / 6))
    kept, ones = torch.exp(-distance / LASTING_KM).unsqueeze(-1), torch.ones_like(belief.mean)
    parts = 0 * ones[..., :COEFFICIENTS], turn.rate.unsqueeze(-1), ones[..., CONSTANT], kept * ones[..., SLOW]
    rest = belief.mean.shape[-1] - COEFFICIENTS
    step = torch.diag_embed(torch.cat((*parts, ones[..., IRON]), -1))
    step = step + pad(torch.cat((matrix, column), -1), (0, rest - 1, 0, rest))
    noise = pad(closure().drift.to(step), (0, rest, 0, rest)) * (distance / UNIT_KM).square()[..., None, None]
    fresh = (1 - kept.square()).unsqueeze(-1) * lasting_covariances(belief.field, errors)[1]
    noise = noise + pad(fresh, (SLOW.start, STATES - SLOW.stop) * 2)
    mean = (step @ belief.mean.unsqueeze(-1)).squeeze(-1)
    return _to_magnetic_north(Belief(mean, step @ belief.covariance @ step.mT + noise, after))


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
    return Belief(mean, step @ belief.covariance @ step.mT, belief.latitude)


def radii(latitude: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radii of curvature [km] along the meridian and across it; that of the sphere where a latitude is NaN.

    Example:
        >>> radii(torch.tensor(math.nan))[0]
        tensor(6371.2002)
    """
    known, middle = ~latitude.isnan(), RADIUS * UNIT_KM
    meridian, vertical = (torch.where(known, radius, middle) for radius in curvature_radii(latitude))
    return meridian, vertical


def innovation(
    belief: Belief,
    reading: Tensor,
    sensor_std: Tensor,
    heading: Tensor | None = None,
    crust_nt: float = 0.0,
    errors: bool = True,
) -> Innovation:
    """Return a reading minus what the belief predicts; arguments as those of :func:`read`.

    Args:
        belief: that before the reading.
        reading: ``(..., 3)``.
        sensor_std: ``(..., 3)``.
        heading: ``(...)`` [rad].
        crust_nt: standard deviation of the crust's field [nT].
        errors: whether the reading has the errors of the state; the true elements of a known place have not.

    Example:
        >>> belief = start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd(torch.tensor([0.05, 0.05, 5.0])))
        >>> reading, std = torch.tensor([3.5, 65.0, 18000.0]), torch.tensor([0.05, 0.05, 5.0])
        >>> innovation(belief, reading, std).residual.round(decimals=1)
        tensor([0.5000, -0.0000, 0.7000], dtype=torch.float64)
    """
    check_tensor(3, reading=reading, sensor_std=sensor_std)
    reading, sensor_std = reading.double(), sensor_std.double()
    present = (sensor_std < math.inf) & (reading == reading) & belief.measured
    vector = field_vector(torch.where(present, reading, _elements(belief.field)))
    jacobian = torch.where(present.unsqueeze(-1), elements_jacobian(vector), 0.0)
    rows = pad(jacobian, (0, COEFFICIENTS - 2))
    if errors:
        own, course = (
            torch.diag_embed(present.double()),
            torch.zeros_like(reading[..., 0]) if heading is None else heading,
        )
        turn = turning(torch.cos(course.double()), torch.sin(course.double()), 1)  # forward, right, down
        rows = torch.cat((rows, own, own, jacobian @ turn), -1)
    rows = pad(rows, (0, belief.mean.shape[-1] - rows.shape[-1]))
    residual = (jacobian @ vector.unsqueeze(-1) - rows @ belief.mean.unsqueeze(-1)).squeeze(-1)
    variance = torch.where(present, sensor_std, 1.0).square()
    noise = torch.diag_embed(variance) + (MODEL_NT**2 + crust_nt**2) * jacobian @ jacobian.mT
    return Innovation(residual, rows, rows @ belief.covariance @ rows.mT + noise)


def updated(belief: Belief, new: Innovation) -> Belief:
    """Return the belief given an innovation: mean x + K r and covariance P - K H P.

    Example:
        >>> belief = before(torch.tensor([3.0, 65.0, 18000.0]), PERFECT)
        >>> updated(belief, innovation(belief, torch.tensor([4.0, 65.0, 18000.0]), torch.ones(3))).mean.shape
        torch.Size([25])
    """
    cross = belief.covariance @ new.rows.mT
    gain = cross @ inverse3(new.covariance)
    mean = belief.mean + (gain @ new.residual.unsqueeze(-1)).squeeze(-1)
    covariance = belief.covariance - gain @ cross.mT
    return Belief(mean, (covariance + covariance.mT) / 2, belief.latitude)  # else, what is not symmetric grows


def read(
    belief: Belief, reading: Tensor, sensor_std: Tensor, heading: Tensor | None = None, crust_nt: float = 0.0
) -> Belief:
    """Return the belief after a reading.

    Args:
        belief: that before the reading.
        reading: ``(..., 3)``: D [deg], I [deg], B_H [nT]; NaN for an element that is missing.
        sensor_std: ``(..., 3)`` standard deviation of the errors that are new in it; infinite for a missing element.
        heading: ``(...)`` [rad, clockwise from true north] of the vehicle, where the state has iron.
        crust_nt: standard deviation of the crust's field in each axis [nT], new in each reading.

    Example:
        >>> belief = before(torch.tensor([3.0, 65.0, 18000.0]), PERFECT)
        >>> read(belief, torch.tensor([3.0, 65.0, 18000.0]), torch.tensor([0.05, 0.05, 5.0])).field.round()
        tensor([17975.,   942., 38601.], dtype=torch.float64)
    """
    return updated(belief, innovation(belief, reading, sensor_std, heading, crust_nt))


def known(belief: Belief, elements: Tensor, std: Tensor, crust_nt: float = 0.0) -> Belief:
    """Return the belief given the true elements of the place, which have none of the errors of a reading.

    Args:
        belief: that before.
        elements: ``(..., 3)``: D [deg], I [deg], B_H [nT], of a map or a pier.
        std: ``(..., 3)`` their standard deviation.
        crust_nt: standard deviation of the crust's field in each axis [nT], where the map has none.

    Example:
        >>> here = torch.tensor([3.0, 65.0, 18000.0])
        >>> belief = known(before(here, SensorStd(bias=torch.ones(3))), here, torch.full((3,), 0.01))
        >>> belief = read(belief, here + torch.tensor([0.8, 0.0, 0.0]), torch.full((3,), 0.01))
        >>> belief.mean[CONSTANT].round(decimals=1)  # the compass is off by 0.8 degrees
        tensor([0.8000, -0.0000, 0.2000], dtype=torch.float64)
    """
    return updated(belief, innovation(belief, elements, std, None, crust_nt, errors=False))


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
    column = elements_jacobian(belief.field) @ turn[2, :3, :3] @ belief.field.unsqueeze(-1) / (cos.square() * vertical)
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
    """Return D, I, B_H of a field; the angles by way of single precision, as ONNX Runtime has no other arc tangent."""
    return measured_elements(field.float()).to(field)


def closed_derivatives() -> Tensor:
    """Return the derivatives ``(2, K, K)`` northward and eastward, with degree 4 as its regression."""
    derivative = generators(DEGREE + 1).derivative[:2, :COEFFICIENTS]
    return derivative @ closure().extend[: size(DEGREE + 1)]


def _carry(north: Tensor, east: Tensor, *angles: Tensor) -> Tensor:
    """Return exp(X) ``(..., K, K)`` of a move [unit] that turns the vertical by angles northward and eastward [rad], to
    the fourth order."""
    steps = torch.cat((closed_derivatives(), generators(DEGREE).turn[:2])).to(north)
    matrix = torch.tensordot(torch.stack((north, east, *angles), -1), steps, 1)
    one = torch.eye(matrix.shape[-1]).to(matrix)
    square = matrix @ matrix
    return one + matrix + square @ (one / 2 + matrix / 6 + square / 24)


def inverse3(matrix: Tensor) -> Tensor:
    """Return the inverses of symmetric matrices ``(..., 3, 3)``, in closed form.

    Example:
        >>> inverse3(torch.diag(torch.tensor([1.0, 2.0, 4.0]))).diagonal()
        tensor([1.0000, 0.5000, 0.2500])
    """
    x, y, z = matrix.unbind(-2)
    adjugate = torch.stack([torch.linalg.cross(*rows) for rows in ((y, z), (z, x), (x, y))], -1)
    return adjugate / (x.unsqueeze(-2) @ adjugate[..., :1]).squeeze(-1).unsqueeze(-1)

"""Magnetic elements: a field vector as angles and intensities (Eq. (1), with signs).

The paper's arccos loses the sign of both angles; ``atan2`` keeps it. Declination and inclination are in degrees,
intensities in nanotesla. The order of the three elements that a vehicle measures is D, I, B_H everywhere. A NaN
component makes every element and derivative that depends on it NaN.
"""

from __future__ import annotations

import torch
from torch import Tensor

NAMES = ("D", "I", "B_H")
"""Elements that a vehicle measures, in the order of every ``field`` tensor."""
UNITS = ("deg", "deg", "nT")
"""Units of :data:`NAMES`."""
FIELD_NT = {"nanotesla": 1.0, "milligauss": 100.0, "microtesla": 1e3, "gauss": 1e5, "millitesla": 1e6, "tesla": 1e9}
"""Units of a magnetic field [nT]."""


def element_index(name: str) -> int:
    """Return the column of an element in a ``field`` tensor.

    Args:
        name: D, I or B_H.

    Raises:
        ValueError: for another name.

    Example:
        >>> element_index("B_H")
        2
    """
    if name not in NAMES:
        raise ValueError(f"unknown magnetic element {name!r}: choose from {', '.join(NAMES)}")
    return NAMES.index(name)


def measured_elements(b_ned: Tensor) -> Tensor:
    """Return D, I, B_H of a field vector: the elements that a vehicle measures.

    Args:
        b_ned: ``(..., 3)`` north, east, down [nT].

    Returns:
        ``(..., 3)``: D [deg], I [deg], B_H [nT].

    Example:
        >>> measured_elements(torch.tensor([30000.0, 0.0, 0.0]))
        tensor([    0.,     0., 30000.])
    """
    north, east, down = b_ned.unbind(-1)
    horizontal = torch.hypot(north, east)
    # Adding zero removes the sign of a zero.
    angles = torch.rad2deg(torch.atan2(torch.stack((east + 0.0, down), -1), torch.stack((north + 0.0, horizontal), -1)))
    return torch.cat((angles, horizontal.unsqueeze(-1)), -1)


def element_difference(elements: Tensor, others: Tensor) -> Tensor:
    """Return D, I, B_H minus others, with the difference of D wrapped to half a turn.

    Args:
        elements: ``(..., E)`` with D [deg] first.
        others: ``(..., E)``.

    Returns:
        ``(..., E)``: D in [-180, 180]; what is there already is not rounded.

    Example:
        >>> element_difference(torch.tensor([179.0, 10.0, 30000.0]), torch.tensor([-179.0, 9.0, 29000.0]))
        tensor([  -2.,    1., 1000.])
    """
    difference = elements - others
    declination = difference[..., 0]
    declination -= 360 * torch.round(declination / 360)  # a view: the difference changes with it
    return difference


def field_vector(elements: Tensor) -> Tensor:
    """Return the field vector of D, I, B_H: the inverse of :func:`measured_elements`.

    Args:
        elements: ``(..., 3)``: D [deg], I [deg, inside (-90, 90)], B_H [nT].

    Returns:
        ``(..., 3)`` north, east, down [nT].

    Example:
        >>> field_vector(torch.tensor([90.0, 0.0, 30000.0])).round()
        tensor([   -0., 30000.,     0.])
    """
    declination, inclination = torch.deg2rad(elements[..., :2]).unbind(-1)
    horizontal = elements[..., 2]
    return torch.stack(
        (horizontal * torch.cos(declination), horizontal * torch.sin(declination), horizontal * torch.tan(inclination)),
        -1,
    )


def elements_jacobian(b_ned: Tensor) -> Tensor:
    """Return the derivatives of D, I, B_H with respect to the field vector.

    Args:
        b_ned: ``(..., 3)`` north, east, down [nT].

    Returns:
        ``(..., 3, 3)``: rows D [deg/nT], I [deg/nT], B_H [1]; columns north, east, down. Where B_H is zero the
        direction of the horizontal field is undefined; the rows of D and B_H are zero there.

    Example:
        >>> elements_jacobian(torch.tensor([100.0, 0.0, 0.0]))[0, 1].deg2rad()  # D turns by 1/B_H per nT eastward
        tensor(0.0100)
    """
    north, east, down = b_ned.unbind(-1)
    horizontal2 = north * north + east * east
    horizontal = torch.sqrt(horizontal2)
    total2 = horizontal2 + down * down
    defined = horizontal2 != 0  # NaN stays NaN
    inverse = torch.where(defined, 1 / torch.where(defined, horizontal, 1.0), 0.0)
    inverse_total2 = torch.where(total2 != 0, 1 / torch.where(total2 != 0, total2, 1.0), 0.0)
    unit_north, unit_east = north * inverse, east * inverse
    zero = torch.zeros_like(north)
    d_row = torch.rad2deg(torch.stack((-unit_east * inverse, unit_north * inverse, zero), -1))
    i_row = torch.stack((-down * unit_north, -down * unit_east, horizontal), -1) * inverse_total2.unsqueeze(-1)
    h_row = torch.stack((unit_north, unit_east, zero), -1)
    return torch.stack((d_row, torch.rad2deg(i_row), h_row), -2)


def elements_gradient(b_ned: Tensor, b_gradient: Tensor) -> Tensor:
    """Return the horizontal gradient of D, I, B_H by the chain rule.

    Args:
        b_ned: ``(..., 3)`` north, east, down [nT].
        b_gradient: ``(..., 3, 2)`` derivative of each component northward and eastward [nT/km].

    Returns:
        ``(..., 3, 2)``: D [deg/km], I [deg/km], B_H [nT/km], each northward and eastward.

    Example:
        >>> elements_gradient(torch.ones(3), torch.zeros(3, 2)).shape
        torch.Size([3, 2])
    """
    return elements_jacobian(b_ned) @ b_gradient


def rotation(attitude_deg: Tensor) -> Tensor:
    """Return the rotation from the vehicle's axes to the world's.

    Args:
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg].

    Returns:
        ``(..., 3, 3)``: forward, right, down to north, east, down, if the heading is from true north.

    Example:
        >>> (rotation(torch.tensor([0.0, 0.0, 90.0])) @ torch.tensor([1.0, 0.0, 0.0])).round()  # forward is east
        tensor([-0., 1., 0.])
    """
    (sr, sp, sh), (cr, cp, ch) = (f(torch.deg2rad(attitude_deg)).unbind(-1) for f in (torch.sin, torch.cos))
    north = cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh
    east = cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch
    return torch.stack((*north, *east, -sp, sr * cp, cr * cp), -1).unflatten(-1, (3, 3))


def elements_of_axes(axes_nt: Tensor, attitude_deg: Tensor) -> Tensor:
    """Return D [deg], I [deg], B_H [nT] ``(..., 3)`` of three axes and an attitude.

    D is from the north of the heading: it is the field's if this is true north.

    Args:
        axes_nt: ``(..., 3)`` the field forward, right, down [nT].
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg].

    Example:
        >>> elements_of_axes(torch.tensor([0.0, -20000.0, 40000.0]), torch.tensor([0.0, 0.0, 90.0])).round()
        tensor([    0.,    63., 20000.])
    """
    return measured_elements((rotation(attitude_deg) @ axes_nt.unsqueeze(-1)).squeeze(-1))


def elements_covariance(axes_nt: Tensor, attitude_deg: Tensor, axes_std: Tensor, attitude_std: Tensor) -> Tensor:
    """Return the covariance of :func:`elements_of_axes` ``(..., 3, 3)``, to first order in independent errors.

    Errors of roll and pitch change D, I and B_H together. The roots of the diagonal are standard deviations for
    :class:`~magrl.sensor_std.SensorStd`: of its noise for errors that are new in each reading, of its bias for others.

    Args:
        axes_nt: ``(..., 3)`` the field forward, right, down [nT]; not vertical in the world, where D has no meaning.
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg].
        axes_std: ``(..., 3)`` standard deviations of the axes [nT].
        attitude_std: ``(..., 3)`` standard deviations of roll, pitch, heading [deg].

    Example:
        >>> axes, level, std = torch.tensor([20000.0, 0.0, 40000.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 0.5])
        >>> elements_covariance(axes, level, torch.zeros(3), std).diagonal().sqrt()  # the heading is an error of D
        tensor([0.5000, 0.0000, 0.0000])
    """
    given = torch.cat(torch.broadcast_tensors(axes_nt, attitude_deg), -1)
    std = torch.cat(torch.broadcast_tensors(axes_std, attitude_std), -1)
    # Rows do not depend on each other: the derivative of their sum holds those of each.
    total = torch.func.jacrev(lambda rows: elements_of_axes(rows[..., :3], rows[..., 3:]).reshape(-1, 3).sum(0))
    scaled = total(given).movedim(0, -2) * std.unsqueeze(-2)
    return scaled @ scaled.mT


def axes_of_elements(elements: Tensor, attitude_deg: Tensor) -> Tensor:
    """Return the field along the vehicle's axes [nT] ``(..., 3)``: the inverse of :func:`elements_of_axes`.

    Args:
        elements: ``(..., 3)`` D [deg], I [deg, inside (-90, 90)], B_H [nT].
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg], the heading from the north of D.

    Example:
        >>> axes_of_elements(torch.tensor([0.0, 0.0, 20000.0]), torch.tensor([0.0, 0.0, 90.0])).round()
        tensor([ -0., -20000., 0.])
    """
    return (rotation(attitude_deg).mT @ field_vector(elements).unsqueeze(-1)).squeeze(-1)

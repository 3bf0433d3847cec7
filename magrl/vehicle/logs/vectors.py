"""From three axes of a magnetometer and an attitude to D, I and B_H, and back.

The vehicle's axes are forward, right, down (FRD), the world's north, east, down (NED). Roll (right side down), pitch
(nose up) and heading (clockwise) turn the world's axes into the vehicle's in the order heading, pitch, roll (ZYX).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_choice, check_numbers, check_tensor
from magrl.field.elements import elements_jacobian, field_vector, measured_elements
from magrl.transforms.errors.sensors import OUTAGE_STD

NORTHS = ("true", "magnetic", "model")
"""North of a heading: that of a gyrocompass, of a compass, or of a compass that adds the declination of a model."""
FRAMES: Mapping[str, Sequence[float]] = {"FRD": (1.0, 1.0, 1.0), "FLU": (1.0, -1.0, -1.0)}
"""Signs of forward, right and down in the vehicle's axes; ROS has forward, left, up."""


class MeasuredElements(NamedTuple):
    """Elements that a vehicle measured: D [deg], I [deg], B_H [nT], ``(..., 3)``, and how accurate they are.

    ``std`` ``(..., 3)`` are their standard deviations, ``correlation`` ``(..., 3, 3)`` their correlations.

    Example:
        >>> MeasuredElements._fields
        ('elements', 'std', 'correlation')
    """

    elements: Tensor
    std: Tensor
    correlation: Tensor


def rotation(attitude_deg: Tensor) -> Tensor:
    """Return the rotation from the vehicle's axes to those of the world.

    Args:
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg].

    Returns:
        ``(..., 3, 3)``: forward, right, down to north, east, down, if the heading is from true north.

    Example:
        >>> (rotation(torch.tensor([0.0, 0.0, 90.0])) @ torch.tensor([1.0, 0.0, 0.0])).round()  # forward is east
        tensor([-0., 1., 0.])
    """
    check_tensor(3, attitude_deg=attitude_deg)
    (sr, sp, sh), (cr, cp, ch) = (f(torch.deg2rad(attitude_deg)).unbind(-1) for f in (torch.sin, torch.cos))
    north = cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh
    east = cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch
    return torch.stack((*north, *east, -sp, sr * cp, cr * cp), -1).unflatten(-1, (3, 3))


def attitude_of(quaternion: Tensor) -> Tensor:
    """Return roll, pitch, heading [deg] ``(..., 3)`` of a rotation from the vehicle's axes to those of the world.

    Args:
        quaternion: ``(..., 4)`` w, x, y, z, of any length.

    Example:
        >>> attitude_of(torch.tensor([1.0, 0.0, 0.0, 1.0])).round()
        tensor([ 0., 0., 90.])
    """
    check_tensor(4, quaternion=quaternion)
    w, x, y, z = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(-1)
    roll = torch.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = torch.asin((2 * (w * y - x * z)).clamp(-1, 1))
    heading = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return torch.rad2deg(torch.stack((roll, pitch, heading), -1))


def from_enu(attitude_deg: Tensor) -> Tensor:
    """Return the attitude in FRD and NED of one in FLU and east, north, up (ROS, REP 103), and the reverse.

    Args:
        attitude_deg: ``(..., 3)`` roll, pitch (nose down), yaw (counterclockwise from east) [deg].

    Example:
        >>> from_enu(torch.tensor([1.0, 2.0, 90.0]))
        tensor([ 1., -2., 0.])
    """
    check_tensor(3, attitude_deg=attitude_deg)
    roll, pitch, yaw = attitude_deg.unbind(-1)
    return torch.stack((roll, -pitch, 90 - yaw), -1)


def elements_of_axes(
    axes_nt: Tensor,
    attitude_deg: Tensor,
    *,
    north: str,
    frame: str = "FRD",
    axes_std_nt: Sequence[float] = (0.0, 0.0, 0.0),
    attitude_std_deg: Sequence[float] = (0.0, 0.0, 0.0),
) -> MeasuredElements:
    """Return D, I, B_H of three axes and an attitude, with standard deviations and correlations to first order.

    The heading decides what D is: only one from true north measures it. With a heading from magnetic north, D is that
    of the compass, and with the declination of a model, that of the model. Neither gives information on the place: the
    standard deviation is :data:`~magrl.transforms.errors.sensors.OUTAGE_STD`, so that a filter ignores D.

    Args:
        axes_nt: ``(..., 3)`` the field along the axes of ``frame`` [nT].
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg], of FRD and NED.
        north: one of :data:`NORTHS`.
        frame: one of :data:`FRAMES`.
        axes_std_nt: standard deviations of the axes [nT].
        attitude_std_deg: standard deviations of roll, pitch, heading [deg].

    Raises:
        ValueError: for an unknown north or frame, another shape, or a negative standard deviation.

    Example:
        >>> axes, attitude = torch.tensor([0.0, -20000.0, 40000.0]), torch.tensor([0.0, 0.0, 90.0])
        >>> measured = elements_of_axes(axes, attitude, north="true", attitude_std_deg=(0.1, 0.1, 0.5))
        >>> measured.elements.round(), measured.std.round(decimals=2)  # D has the error of heading and of pitch
        (tensor([    0.,    63., 20000.]), tensor([ 0.5400,  0.1000, 69.8100]))
    """
    check_choice(NORTHS, north=north)
    check_choice(FRAMES, frame=frame)
    check_numbers(3, 0, axes_std_nt=axes_std_nt, attitude_std_deg=attitude_std_deg)
    check_tensor(3, axes_nt=axes_nt)
    turn = rotation(attitude_deg)
    field = (turn @ (axes_nt * axes_nt.new_tensor(FRAMES[frame])).unsqueeze(-1)).squeeze(-1)
    jacobian, turned = elements_jacobian(field), _turns(field, attitude_deg, attitude_std_deg)
    spread = jacobian @ (turn * turn.new_tensor(axes_std_nt)), jacobian @ turned
    covariance = spread[0] @ spread[0].mT + spread[1] @ spread[1].mT
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    scale = torch.where(std > 0, std, 1.0)
    correlation = covariance / scale.unsqueeze(-1) / scale.unsqueeze(-2)
    if north != "true":
        std = torch.cat((torch.full_like(std[..., :1], OUTAGE_STD), std[..., 1:]), -1)
    return MeasuredElements(measured_elements(field), std, correlation)


def _turns(field: Tensor, attitude_deg: Tensor, std_deg: Sequence[float]) -> Tensor:
    """Return what an error of one standard deviation of roll, pitch and heading adds to a vector, ``(..., 3, 3)``.

    A small rotation about an axis adds the cross product with it. Roll turns about the bow, pitch about the level axis
    to its right, heading about the vertical.
    """
    level = torch.cat((torch.zeros_like(attitude_deg[..., :2]), attitude_deg[..., 2:]), -1)
    bow, right = rotation(attitude_deg)[..., 0], rotation(level)[..., 1]
    down = bow.new_tensor((0.0, 0.0, 1.0)).expand_as(bow)
    turned = [torch.linalg.cross(*torch.broadcast_tensors(axis, field)) for axis in (bow, right, down)]
    return torch.stack(turned, -1) * torch.deg2rad(bow.new_tensor(std_deg))


def axes_of_elements(elements: Tensor, attitude_deg: Tensor, *, frame: str = "FRD") -> Tensor:
    """Return the field along the vehicle's axes [nT] ``(..., 3)``: the inverse of :func:`elements_of_axes`.

    Args:
        elements: ``(..., 3)`` D [deg], I [deg, inside (-90, 90)], B_H [nT].
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg], the heading from the north of D.
        frame: one of :data:`FRAMES`.

    Example:
        >>> axes_of_elements(torch.tensor([0.0, 0.0, 20000.0]), torch.tensor([0.0, 0.0, 90.0])).round()
        tensor([ -0., -20000., 0.])
    """
    check_choice(FRAMES, frame=frame)
    field = field_vector(elements).unsqueeze(-1)
    return (rotation(attitude_deg).mT @ field).squeeze(-1) * field.new_tensor(FRAMES[frame])

"""From three axes of a magnetometer and an attitude to D, I and B_H, and back.

The vehicle's axes are forward, right, down (FRD), the world's north, east, down (NED). Roll (right side down), pitch
(nose up) and heading (clockwise) turn the world's axes into the vehicle's in the order heading, pitch, roll (ZYX).
"""

from __future__ import annotations

import torch
from torch import Tensor

from magrl.checks import check_tensor
from magrl.field.elements import field_vector, measured_elements

NORTHS = ("true", "magnetic", "model")
"""North of a heading: that of a gyrocompass, of a compass, or of a compass that adds the declination of a model."""


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


def elements_of_axes(axes_nt: Tensor, attitude_deg: Tensor) -> Tensor:
    """Return D [deg], I [deg], B_H [nT] ``(..., 3)`` of three axes and an attitude.

    D is from the north of the heading: it is that of the field if this is true north.

    Args:
        axes_nt: ``(..., 3)`` the field forward, right, down [nT].
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg].

    Example:
        >>> elements_of_axes(torch.tensor([0.0, -20000.0, 40000.0]), torch.tensor([0.0, 0.0, 90.0])).round()
        tensor([    0.,    63., 20000.])
    """
    check_tensor(3, axes_nt=axes_nt)
    return measured_elements((rotation(attitude_deg) @ axes_nt.unsqueeze(-1)).squeeze(-1))


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

"""Three axes and an attitude to D, I, B_H: round trips, frames, the error model of the simulation, and accuracy."""

from __future__ import annotations

import torch
from torch import Tensor

from magrl.transforms import VectorErrors
from magrl.vehicle.logs import attitude_of, axes_of_elements, elements_of_axes, from_enu, rotation


def cases(count: int = 500) -> tuple[Tensor, Tensor]:
    """Elements, and attitudes of up to 80 degrees of pitch."""
    uniform = torch.rand(count, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    elements = uniform[:, :3] * torch.tensor((180.0, 85.0, 20000.0)) + torch.tensor((0.0, 0.0, 21000.0))
    return elements, uniform[:, 3:] * torch.tensor((180.0, 80.0, 180.0))


def test_elements_to_axes_and_back() -> None:
    elements, attitude = cases()
    found = elements_of_axes(axes_of_elements(elements, attitude), attitude)
    torch.testing.assert_close(found, elements, rtol=1e-9, atol=1e-9)


def test_the_error_model_of_the_simulation_is_the_same_geometry() -> None:
    """What a level vehicle with hard and soft iron reads in the simulation follows from its axes."""
    elements, attitude = cases()
    level = attitude * torch.tensor((0.0, 0.0, 1.0))
    iron = VectorErrors(hard_iron_nt=(50.0, -20.0, 10.0), soft_iron=((0.01, 0.02, 0.0),) * 3, fixed=True)
    read = iron.disturb(elements, torch.deg2rad(level[:, 2:]), iron.constants(torch.zeros(14, dtype=torch.float64)))
    matrix = torch.eye(3, dtype=torch.float64) + torch.tensor(iron.soft_iron, dtype=torch.float64)
    axes = axes_of_elements(elements, level) @ matrix.mT + torch.tensor(iron.hard_iron_nt)
    found = elements_of_axes(axes, level)
    torch.testing.assert_close(torch.remainder(found - read + 180, 360), torch.full_like(read, 180.0))


def test_an_attitude_of_ros() -> None:
    """The rotation in the axes of ROS is that in FRD and NED, between swapped axes."""
    attitude = cases()[1]
    world = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    vehicle = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    torch.testing.assert_close(rotation(from_enu(attitude)), world @ rotation(attitude) @ vehicle)
    torch.testing.assert_close(from_enu(from_enu(attitude)), attitude)


def test_a_quaternion_is_its_rotation() -> None:
    roll, pitch, heading = torch.deg2rad(cases()[1]).unbind(-1)
    (a, b, c), (d, e, f) = ([fun(x / 2) for x in (roll, pitch, heading)] for fun in (torch.cos, torch.sin))
    parts = a * b * c + d * e * f, d * b * c - a * e * f, a * e * c + d * b * f, a * b * f - d * e * c
    torch.testing.assert_close(attitude_of(3 * torch.stack(parts, -1)), cases()[1])

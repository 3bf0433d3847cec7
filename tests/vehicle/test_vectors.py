"""Three axes and an attitude to D, I, B_H: round trips, frames, the error model of the simulation, and accuracy."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from magrl.transforms import VectorErrors
from magrl.transforms.errors.sensors import OUTAGE_STD
from magrl.vehicle.logs import attitude_of, axes_of_elements, elements_of_axes, from_enu, rotation


def cases(count: int = 500) -> tuple[Tensor, Tensor]:
    """Elements, and attitudes of up to 80 degrees of pitch."""
    uniform = torch.rand(count, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    elements = uniform[:, :3] * torch.tensor((180.0, 85.0, 20000.0)) + torch.tensor((0.0, 0.0, 21000.0))
    return elements, uniform[:, 3:] * torch.tensor((180.0, 80.0, 180.0))


@pytest.mark.parametrize("frame", ["FRD", "FLU"])
def test_elements_to_axes_and_back(frame: str) -> None:
    elements, attitude = cases()
    axes = axes_of_elements(elements, attitude, frame=frame)
    found = elements_of_axes(axes, attitude, north="true", frame=frame).elements
    torch.testing.assert_close(found, elements, rtol=1e-9, atol=1e-9)


def test_a_frame_is_that_of_its_axes() -> None:
    """By hand: heading east, the field is north and down: to the left, and down."""
    elements, attitude = torch.tensor([0.0, 45.0, 100.0]), torch.tensor([0.0, 0.0, 90.0])
    assert axes_of_elements(elements, attitude).round().tolist() == [0, -100, 100]
    assert axes_of_elements(elements, attitude, frame="FLU").round().tolist() == [0, 100, -100]


def test_the_error_model_of_the_simulation_is_the_same_geometry() -> None:
    """What a level vehicle with hard and soft iron reads in the simulation follows from its axes."""
    elements, attitude = cases()
    level = attitude * torch.tensor((0.0, 0.0, 1.0))
    iron = VectorErrors(hard_iron_nt=(50.0, -20.0, 10.0), soft_iron=((0.01, 0.02, 0.0),) * 3, fixed=True)
    read = iron.disturb(elements, torch.deg2rad(level[:, 2:]), iron.constants(torch.zeros(14, dtype=torch.float64)))
    matrix = torch.eye(3, dtype=torch.float64) + torch.tensor(iron.soft_iron, dtype=torch.float64)
    axes = axes_of_elements(elements, level) @ matrix.mT + torch.tensor(iron.hard_iron_nt)
    found = elements_of_axes(axes, level, north="true").elements
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


def test_standard_deviations_and_correlations() -> None:
    """Those of 40 000 readings with such errors, at a bank angle of 20 degrees."""
    elements, attitude = torch.tensor([10.0, 60.0, 20000.0]).double(), torch.tensor([20.0, -10.0, 200.0]).double()
    stated = {"axes_std_nt": (20.0, 10.0, 40.0), "attitude_std_deg": (0.1, 0.2, 0.3)}
    normal = torch.randn(2, 40000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    axes = axes_of_elements(elements, attitude) + normal[0] * torch.tensor(stated["axes_std_nt"])
    found = elements_of_axes(
        axes, attitude + normal[1] * torch.tensor(stated["attitude_std_deg"]), north="true"
    ).elements
    measured = elements_of_axes(axes_of_elements(elements, attitude), attitude, north="true", **stated)
    torch.testing.assert_close(found.std(0), measured.std, rtol=0.02, atol=0)
    torch.testing.assert_close(torch.corrcoef(found.T), measured.correlation, rtol=0, atol=0.02)
    exact = elements_of_axes(axes, attitude, north="true")
    assert exact.std.abs().max() == 0


@pytest.mark.parametrize("north", ["magnetic", "model"])
def test_a_compass_measures_no_declination(north: str) -> None:
    elements, attitude = torch.tensor([0.0, 60.0, 20000.0]), torch.tensor([0.0, 0.0, 123.0])
    found = elements_of_axes(axes_of_elements(elements, attitude), attitude, north=north)
    assert found.std.tolist() == [OUTAGE_STD, 0, 0]
    assert math.isclose(found.elements[0], 0, abs_tol=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"north": "grid"}, "north must be one of 'true', 'magnetic', 'model', got 'grid'"),
        ({"north": "true", "frame": "FRU"}, "frame must be one of 'FRD', 'FLU', got 'FRU'"),
        ({"north": "true", "axes_std_nt": (1.0, -1.0, 1.0)}, "axes_std_nt must be a finite number from 0 on, got -1"),
    ],
)
def test_wrong_options(options, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        elements_of_axes(torch.ones(3), torch.zeros(3), **options)

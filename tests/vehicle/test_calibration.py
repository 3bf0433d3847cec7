"""Axes and their calibration: round trips and frames; a simulated swing, what it leaves and states, and refusals."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from magrl.files import DamagedFileError
from magrl.transforms import VectorErrors
from magrl.vehicle.logs import (
    Calibration,
    attitude_of,
    axes_of_elements,
    calibrate,
    elements_of_axes,
    from_enu,
    rotation,
)

BERGEN = (2.84, 73.05, 15003.0)
FIELD = torch.tensor(BERGEN, dtype=torch.float64)
TILTS = (0, 0), (5, 0), (-5, 0), (0, 5), (0, -5)
LIMITS = torch.tensor([0.1, 0.05, 15.0])
LEVEL = torch.tensor([(*tilt, 30 * turn) for tilt in TILTS for turn in range(12)], dtype=torch.float64)


def swing(seed: int = 0, tilt: float = 20.0, headings: float = 1080.0) -> tuple[Tensor, Tensor, Tensor]:
    """Axes and attitude of 3000 samples with 30 nT and .1 degrees, and what LEVEL attitudes read without noise."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(6006, 3, dtype=torch.float64, generator=generator)
    time = torch.linspace(0, 2 * math.pi, 3000, dtype=torch.float64)
    waves = tilt * torch.sin(7.3 * time), tilt * torch.sin(11.7 * time + 1)
    attitude = torch.stack((*waves, headings * time / time[-1]), -1)
    iron = torch.eye(3) + 0.03 * normal[:3], 500 * normal[3]
    axes, level = (axes_of_elements(FIELD, each) @ iron[0].T + iron[1] for each in (attitude, LEVEL))
    return axes + 30 * normal[6:3006], attitude + 0.1 * normal[3006:], level


def left(calibration: Calibration, level: Tensor) -> Tensor:
    """Mean square errors of D, I, B_H after a calibration."""
    found = elements_of_axes(calibration.apply(level), LEVEL)
    return (found - FIELD).square().mean(0)


def test_what_a_swing_leaves_and_states() -> None:
    squares, stated = [], []
    for seed in range(15):
        axes, attitude, level = swing(seed)
        calibration = calibrate(axes, BERGEN, attitude_deg=attitude)
        squares.append(left(calibration, level))
        stated.append(torch.tensor(calibration.std))
    rest, std = torch.stack(squares).amax(0).sqrt(), torch.stack(stated)
    assert (rest < LIMITS).all()
    assert 0.8 < (torch.stack(squares) / std.square()).mean() < 1.25


@pytest.mark.parametrize(("options", "times"), [({"headings": 90.0}, 1.3), ({"tilt": 0.0}, 4.0)])
def test_a_poor_swing_states_more(options, times: float) -> None:
    """A quarter of the headings, and none of roll and pitch."""
    axes, attitude, _ = swing()
    whole = calibrate(axes, BERGEN, attitude_deg=attitude)
    axes, attitude, level = swing(**options)
    poor = calibrate(axes, BERGEN, attitude_deg=attitude)
    assert (torch.tensor(poor.std) > times * torch.tensor(whole.std)).all()
    assert (left(poor, level).sqrt() < 4 * torch.tensor(poor.std)).all()


def test_the_length_alone() -> None:
    """Without attitude, hard iron and the symmetric part of soft iron are found; the alignment stays as stated."""
    directions = torch.randn(4000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    total = 15003.0 / math.cos(math.radians(73.05))
    soft = torch.tensor([[1.03, 0.01, 0.0], [0.01, 0.98, -0.02], [0.0, -0.02, 1.0]], dtype=torch.float64)
    iron = torch.tensor([500.0, -300.0, 200.0])
    axes = total * directions / directions.norm(dim=-1, keepdim=True) @ soft + iron
    axes = axes + 30 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(2))
    calibration = calibrate(axes, BERGEN, alignment_deg=0.01)
    level = axes_of_elements(FIELD, LEVEL) @ soft + iron
    error = left(calibration, level).sqrt()
    assert (error < LIMITS).all()
    turned = calibrate(axes, BERGEN, alignment_deg=1.0).std
    assert turned[0] > 1.0  # one degree of each axis
    crust = calibrate(axes, (60.4, 5.3), date="2026-06-30", alignment_deg=0.01).std[2]
    assert crust == pytest.approx(math.hypot(133, 49200 * math.radians(0.2)), rel=0.01)


@pytest.mark.parametrize("side", [1, -1])
def test_half_of_the_directions_without_attitude(side: int) -> None:
    """A gain of .83, and 1.6 % of noise: errors of the inclination, which may be on the other side, are as stated."""
    elements, iron = (-2.0, 66.0, 19800.0), torch.tensor([4700.0, 100.0, 1800.0])
    level = axes_of_elements(torch.tensor(elements).double(), LEVEL)
    squares = []
    for seed in range(10):
        normal = torch.randn(6000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
        directions = normal / normal.norm(dim=-1, keepdim=True)
        half = directions[side * directions[:, 2] > 0.2][:600]
        swung = calibrate(0.83 * 48680 * half + iron + 800 * normal[-600:], elements, alignment_deg=0.01)
        inclination = elements_of_axes(swung.apply(0.83 * level + iron), LEVEL)[:, 1]
        squares.append((inclination - 66).square().mean() / swung.std[1] ** 2)
        assert swung.offset_nt[2] == pytest.approx(1800, abs=4000)
        assert swung.std[1] < 1.5
    assert 0.2 < torch.stack(squares).mean() < 2


def test_spikes_are_left_out() -> None:
    axes, attitude, level = swing()
    axes[::50] += 20000
    calibration = calibrate(axes, BERGEN, attitude_deg=attitude)
    assert calibration.outliers == pytest.approx(0.02)
    assert left(calibration, level).sqrt()[2] < 15


AXES = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m[:, [1, 0, 2]], "fit right, forward, down, and forward.*: a left-handed frame"),
        (lambda m: m * torch.tensor([1.0, -1.0, -1.0]), "fit forward, minus right, minus down, and [^:]*, or the"),
        (lambda m: m @ AXES, "fit forward, right, minus down.*: a left-handed frame; change the sign of one axis"),
        (lambda m: torch.cat((m[:600] + 20000, m[600:])), "20 % of the samples deviate"),
        (lambda m: m.flip(0), "deviate by .* nT from one field of 51[0-9]* nT: check the place, the times"),
    ],
)
def test_samples_that_are_refused(change, message: str) -> None:
    axes, attitude, _ = swing(tilt=40.0)
    with pytest.raises(ValueError, match=message):
        calibrate(change(axes), BERGEN, attitude_deg=attitude)


@pytest.mark.parametrize(("tilt", "message"), [(0.0, "1 % of its strength, where 5 % are needed"), (20.0, "leave D ")])
def test_a_swing_without_attitude_needs_roll_and_pitch(tilt: float, message: str) -> None:
    with pytest.raises(ValueError, match=rf"too few directions.*{message}.*swing the vehicle: slowly through all"):
        calibrate(swing(1, tilt)[0], BERGEN, alignment_deg=5.0)


def test_a_file_holds_all(tmp_path: Path) -> None:
    axes, attitude, _ = swing()
    calibration = calibrate(axes, (60.4, 5.3), date="2026-06-30", attitude_deg=attitude)
    calibration.save(tmp_path / "quay.json")
    assert Calibration.load(tmp_path / "quay.json") == calibration
    assert calibration.here == (60.4, 5.3)
    assert calibration.date == "2026-06-30"
    (tmp_path / "quay.json").write_text('{"matrix": 3}', encoding="utf-8")
    with pytest.raises(DamagedFileError, match=r"quay.json is not a calibration"):
        Calibration.load(tmp_path / "quay.json")


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

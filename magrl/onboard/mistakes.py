"""A reading that does not fit the field at its place, and the mistake that explains it."""

from __future__ import annotations

import torch
from torch import Tensor

from magrl.field.elements import FIELD_NT, NAMES, element_difference, field_vector

MODEL_STD = (0.26, 0.20, 133.0)
"""Standard deviations of D [deg], I [deg], B_H [nT] of a model of the core, which omits crust and currents.

To D, ``MODEL_D_NT / B_H`` degrees are added in squares. Source: the error model of the World Magnetic Model
2025 (technical report, NOAA NCEI and British Geological Survey, 2024).
"""
MODEL_D_NT = 5417.0
MOST_SIGMAS = 5.0
"""Deviation of a reading beyond which it does not fit the expected elements, in standard deviations."""
SLACK_NT = 100.0
"""Deviation of the field vector that always fits; chosen [nT]."""
IRON_NT = 2000.0
"""Standard deviation of the iron of a vehicle along each of its axes, before a calibration; chosen [nT]."""
IRON_COST = 15.0
"""What iron must explain more, as a sum of squared standard deviations, since it can take any value; chosen."""


def model_std(elements: Tensor) -> Tensor:
    """Return the standard deviations of D [deg], I [deg], B_H [nT] of a model of the core ``(..., 3)``.

    Args:
        elements: ``(..., 3)`` elements of the model.

    Example:
        >>> model_std(torch.tensor([3.5, 73.0, 15000.0]))
        tensor([  0.4450,   0.2000, 133.0000])
    """
    std = elements.new_tensor(MODEL_STD).expand_as(elements)
    return torch.hypot(std, torch.nn.functional.pad(MODEL_D_NT / elements[..., 2:], (0, 2)))


def _most(expected: Tensor, std: Tensor) -> Tensor:
    """Return the largest deviations from expected elements that are likely ``(..., 3)``."""
    strength = torch.stack((expected[..., 2].clamp_min(SLACK_NT), field_vector(expected).norm(dim=-1)), -1)
    slack = torch.cat((torch.rad2deg(SLACK_NT / strength), torch.full_like(strength[..., :1], SLACK_NT)), -1)
    return MOST_SIGMAS * std + slack


def deviation(elements: Tensor, expected: Tensor, std: Tensor) -> str | None:
    """Return how a reading deviates from expected elements, as text; None for one that fits.

    Args:
        elements: ``(3,)`` D [deg], I [deg], B_H [nT].
        expected: ``(3,)`` the elements at its place.
        std: ``(3,)`` standard deviations of the difference.

    Example:
        >>> deviation(torch.tensor([3.4, -73.1, 14950.0]), torch.tensor([3.5, 73.0, 15000.0]), torch.zeros(3))
        'I deviates by 146.1, where 0.112 is likely'
    """
    off, most = element_difference(elements, expected).abs(), _most(expected, std)
    worst = int((off / most).argmax())
    if off[worst] <= most[worst]:
        return None
    return f"{NAMES[worst]} deviates by {off[worst]:.4g}, where {most[worst]:.3g} is likely"


def likely_mistake(elements: Tensor, expected: Tensor, std: Tensor) -> str | None:
    """Return the mistake that explains a reading better than others and than iron; None without one.

    Iron explains any reading; its standard deviation along each axis of the vehicle is :data:`IRON_NT`.

    Args:
        elements: ``(3,)`` D [deg], I [deg], B_H [nT].
        expected: ``(3,)`` the elements at its place.
        std: ``(3,)`` standard deviations of the difference.

    Example:
        >>> read, there = torch.tensor([3.4, -73.1, 14950.0]), torch.tensor([3.5, 73.0, 15000.0])
        >>> likely_mistake(read, there, torch.tensor([0.5, 0.1, 50.0]))
        'it fits with -I: the vertical axis points up, and down is expected'
    """
    iron = (field_vector(elements) - field_vector(expected)) / IRON_NT
    costs = {"": IRON_COST + iron.square().sum().item()}
    for text, read in _mistakes(elements, expected).items():
        shares = element_difference(read, expected) / _most(expected, std)
        if (shares.abs() <= 1).all():
            costs[text] = MOST_SIGMAS**2 * shares.square().sum().item()
    return min(costs, key=lambda text: costs[text]) or None


def _mistakes(elements: Tensor, expected: Tensor) -> dict[str, Tensor]:
    """Return what a reading would be without each of the mistakes that engineers make."""
    d, i, b = elements.unbind(-1)
    wrong = {
        "it fits with -I: the vertical axis points up, and down is expected": (d, -i, b),
        "it fits with -D: D is positive where magnetic north is east of true north": (-d, i, b),
        "it fits with -D and -I: the axes point left and up, and right and down are expected": (-d, -i, b),
        "it fits in radians, and degrees are expected": (d.rad2deg(), i.rad2deg(), b),
        "I fits in radians, and degrees are expected": (d, i.rad2deg(), b),
        "D fits in radians, and degrees are expected": (d.rad2deg(), i, b),
        "D fits in minutes of arc, and degrees are expected": (d / 60, i, b),
        "D and I are swapped": (i, d, b),
        "it fits with D + 180: the horizontal axes point backward": (d + 180, i, b),
        "it fits with 90 - D: the horizontal axes are swapped": (90 - d, i, b),
        "B_H is the total intensity: the horizontal one is expected": (d, i, b * i.deg2rad().cos()),
        "D is 0: the heading is from magnetic north, and true north is expected": (d + expected[..., 0], i, b),
    }
    units = [(unit, factor) for unit, factor in FIELD_NT.items() if factor > 1]
    wrong |= {f"B_H looks like {unit}, and nanotesla are expected": (d, i, factor * b) for unit, factor in units}
    return {text: torch.stack(values, -1) for text, values in wrong.items()}

"""Calibration of a vector magnetometer in its vehicle: hard iron, soft iron, misalignment, and remaining errors."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import permutations, product
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import Strict
from torch import Tensor
from torch.nn.functional import normalize

from magrl.checks import CheckedModel, check_number, check_numbers, check_tensor
from magrl.field import IGRF, elements_at
from magrl.field.elements import elements_jacobian, field_vector
from magrl.files import DamagedFileError, read_text, write_json
from magrl.vehicle.logs.conventions import check_intensity, rotation
from magrl.vehicle.onboard.known import known_elements

GAIN_STD, SOFT_IRON_STD, HARD_IRON_STD = 0.3, 0.05, 1.0
"""Standard deviations before the swing, as shares of the field: of the gain that the axes have in common, of each entry
of soft iron, and of hard iron; chosen."""
MOST_STD = (10.0, 4.0, 1000.0)
"""Standard deviations of D [deg], I [deg], B_H [nT] beyond which a calibration is refused; chosen."""
TILT_DEG = 5.0
"""Roll and pitch up to which the standard deviations hold [deg]."""
LEAST_SAMPLES = 100
LEAST_SPREAD = 0.05
LEAST_CHANGE = 0.01
"""Change of the known field along a direction, as a share of it, below which it may be noise of the attitude."""
MOST_OUTLIERS = 0.1
OUTLIER_SIGMAS = 5.0
_BLOCKS = 100  # of consecutive samples, whose errors are not independent
_ROUNDS, _SETTLED, _MOVING = 20, 1e-7, 1e-3  # of the fit: a swing converges in 4 to 8; changes of mix and offset
_SWING = (
    "swing the vehicle: slowly through all headings, with as much roll and pitch to both sides as possible (turn a "
    "vehicle in the hand once onto every side)"
)
_AXES = ("forward", "right", "down")
_SIGNS = list(product((1.0, -1.0), repeat=3))
_LISTS = Strict(False)  # of JSON
Row = Annotated[tuple[float, float, float], _LISTS]


class Calibration(CheckedModel):
    """Correction ``matrix (m - offset)`` of three axes m, and how accurate it is.

    Args:
        matrix: 3 x 3, in the vehicle's axes forward, right, down.
        offset_nt: hard iron, forward, right, down [nT].
        method: "vector", with the attitude of each sample, or "ellipsoid", by the total intensity alone.
        std: standard deviations of D [deg], I [deg], B_H [nT] that it leaves: the ``bias_std`` of a vehicle.
        noise_nt: root mean square of the residuals of a sample [nT].
        samples: number of samples.
        outliers: share of them that were left out.
        date: date of the swing.
        here: latitude and longitude of the swing [deg], or D, I, B_H.

    Raises:
        ValueError: naming each value that is wrong.

    Example:
        >>> one = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> options = {"std": (0.1, 0.1, 9.0), "noise_nt": 30.0, "samples": 600, "outliers": 0.0, "here": (60.4, 5.3)}
        >>> iron = Calibration(matrix=one, offset_nt=(500.0, 0.0, 0.0), method="vector", **options)
        >>> iron.apply(torch.tensor([15500.0, 0.0, 45000.0]))
        tensor([15000., 0., 45000.])
    """

    matrix: Annotated[tuple[Row, Row, Row], _LISTS]
    offset_nt: Row
    method: Literal["vector", "ellipsoid"]
    std: Row
    noise_nt: float
    samples: int
    outliers: float
    here: Annotated[tuple[float, ...], _LISTS]
    date: str | None = None

    def apply(self, axes_nt: Tensor) -> Tensor:
        """Return corrected axes [nT] ``(..., 3)``."""
        check_tensor(3, axes_nt=axes_nt)
        return (axes_nt - axes_nt.new_tensor(self.offset_nt)) @ axes_nt.new_tensor(self.matrix).mT

    def save(self, path: Path | str) -> None:
        """Write the calibration to a JSON file."""
        write_json(Path(path), self.model_dump())

    @classmethod
    def load(cls, path: Path | str) -> Calibration:
        """Read a file of :meth:`save`.

        Raises:
            DamagedFileError: naming the file and what is wrong with it.
        """
        try:
            return cls(**json.loads(read_text(Path(path))))
        except (ValueError, TypeError, OSError, RecursionError, OverflowError) as error:
            raise DamagedFileError(f"{path} is not a calibration: {error}") from error


def calibrate(
    axes_nt: Tensor,
    here: Sequence[float],
    *,
    date: str | None = None,
    here_std: Sequence[float] | None = None,
    attitude_deg: Tensor | None = None,
    alignment_deg: float = 0.5,
) -> Calibration:
    """Fit a calibration to the samples of a swing at one place.

    With the attitude of each sample, the samples are fitted by the known vector, distorted by iron. Without it, they
    are fitted by an ellipsoid, which does not show a misalignment of the axes. The fit is least squares without
    outliers. Its prior is :data:`GAIN_STD`, :data:`SOFT_IRON_STD`, :data:`HARD_IRON_STD` and ``alignment_deg``, which
    remain where the swing shows nothing. The standard deviations allow for errors that last a hundredth of the swing,
    hold for a field such as of the swing and tilts of :data:`TILT_DEG`, and include the errors of the known elements.

    Args:
        axes_nt: ``(N, 3)`` forward, right, down [nT].
        here: D [deg], I [deg], B_H [nT] at the place, or latitude and longitude [deg] for IGRF, as in
            :meth:`magrl.vehicle.onboard.Onboard.start`.
        date: date for IGRF, which latitude and longitude need.
        here_std: standard deviations of the elements.
        attitude_deg: ``(N, 3)`` roll, pitch, heading from true north [deg].
        alignment_deg: standard deviation of the misalignment of the axes before the swing [deg].

    Raises:
        ValueError: for samples that are too few, in another unit, along other axes, with too many outliers, or from too
            few directions, each with the remedy.

    Source:
        V. Renaudin, M. H. Afzal and G. Lachapelle, Complete triaxis magnetometer calibration in the magnetic domain,
        Journal of Sensors (2010); covariance: H. White, Econometrica 48 (1980), over blocks.

    Example:
        >>> directions = torch.randn(2000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        >>> axes = 50000 * directions / directions.norm(dim=-1, keepdim=True) + torch.tensor([500.0, 0.0, -200.0])
        >>> swung = calibrate(axes, (0.0, 60.0, 25000.0))
        >>> [round(offset) for offset in swung.offset_nt], swung.method
        ([500, 0, -200], 'ellipsoid')
    """
    model = None if date is None else lambda place: elements_at(IGRF(date), place)
    elements, model_std, _ = known_elements(here, "here", model)
    elements_std = model_std if here_std is None else here_std
    check_numbers(3, 0, here_std=elements_std)
    check_number(0, above=True, alignment_deg=alignment_deg)
    axes, reference = axes_nt.double(), field_vector(torch.tensor(elements, dtype=torch.float64))
    scale, std = float(reference.norm()), torch.tensor(elements_std, dtype=torch.float64)
    _check_samples(axes, scale)
    shares = axes / scale
    level = _expected_field(shares, reference / scale, attitude_deg)
    mix, offset, covariance, noise, inliers = _fit(shares, level, math.radians(alignment_deg), 1 / scale)
    matrix, outliers = torch.linalg.inv(mix), 1 - float(inliers.double().mean())
    _check_fit(scale * noise, outliers, scale)
    if attitude_deg is None:  # the known intensity is a scale: of B_H alone
        std = torch.stack((*torch.zeros(2), torch.hypot(std[2], torch.deg2rad(std[1]) * reference[2])))
    std = torch.hypot(_remaining_std(mix, covariance, reference), std)
    _check_std(std)
    rows = {"matrix": matrix, "offset_nt": scale * offset, "std": std}
    return Calibration(
        **{name: row.tolist() for name, row in rows.items()},
        method="ellipsoid" if attitude_deg is None else "vector",
        noise_nt=scale * noise,
        samples=len(axes),
        outliers=outliers,
        here=tuple(map(float, here)),
        date=date,
    )


def _expected_field(shares: Tensor, reference: Tensor, attitude_deg: Tensor | None) -> Tensor | None:
    """Return the known field along the vehicle's axes ``(N, 3)``, or None without attitude.

    Along directions in which it changes by less than the noise of the attitude, return its mean: least squares would
    fit that noise as a change of the field.
    """
    if attitude_deg is None:
        _check_directions(shares)
        return None
    level = reference @ rotation(attitude_deg.double())
    _check_axes(shares, level)
    change = level - level.mean(0)
    variance, directions = torch.linalg.eigh(change.T @ change / len(level))
    return level.mean(0) + change @ (directions * (variance > LEAST_CHANGE**2)) @ directions.T


# The fit


def _design(field: Tensor) -> Tensor:
    """Return the derivatives ``(..., 3, 12)`` of ``mix @ field + offset`` with respect to mix and offset."""
    eye = torch.eye(3, dtype=field.dtype)
    rows = torch.einsum("ij,...k->...ijk", eye, field).flatten(-2)
    return torch.cat((rows, eye.expand(*field.shape[:-1], 3, 3)), -1)


def _misfit(axes: Tensor, level: Tensor | None, mix: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return residuals ``(N, R)`` of the samples as they were measured, and their derivatives ``(N, R, 12)``.

    Without known vectors, they are the distances from the ellipsoid ``mix @ field + offset`` of all fields of length 1,
    to first order. Residuals of corrected samples would favor a correction that shrinks the samples.
    """
    moved, inverse = axes - offset, torch.linalg.inv(mix)
    field = normalize(moved @ inverse.mT, dim=-1) if level is None else level
    error, design = moved - field @ mix.mT, _design(field)
    if level is not None:
        return error, design
    normal = normalize(field @ inverse, dim=-1).unsqueeze(-2)
    return (normal @ error.unsqueeze(-1)).squeeze(-1), normal @ design


def _start(axes: Tensor, level: Tensor | None) -> Tensor:
    """Return mix and offset ``(12,)`` before the fit: the sphere ``|m|^2 = 2 m c + r^2 - |c|^2`` nearest to samples."""
    eye = torch.eye(3, dtype=torch.float64).flatten()
    if level is not None:
        return torch.cat((eye, (axes - level).median(0).values))
    design = torch.cat((2 * axes, torch.ones_like(axes[:, :1])), -1)
    *center, constant = torch.linalg.lstsq(design, axes.square().sum(-1, keepdim=True)).solution.flatten()
    offset = torch.stack(center)
    return torch.cat((eye * (constant + offset.square().sum()).sqrt(), offset))


def _fit(
    axes: Tensor, level: Tensor | None, alignment: float, least: float
) -> tuple[Tensor, Tensor, Tensor, float, Tensor]:
    """Return mix, offset, their covariance ``(12, 12)``, the root mean square of residuals, and the inliers.

    Gauss-Newton without outliers. The covariance allows for errors that are not independent within blocks of samples.
    All are shares of the field; ``least`` is a residual that is no outlier.
    """
    prior, values = _prior(alignment), _start(axes, level)
    expected = torch.cat((torch.eye(3).flatten(), torch.zeros(3))).double()
    for _ in range(_ROUNDS):
        error, slope = _misfit(axes, level, values[:9].unflatten(0, (3, 3)), values[9:])
        size = error.norm(dim=-1)
        inliers = size <= max(OUTLIER_SIGMAS * 1.4826 * float(size.median()), least)
        variance = error[inliers].square().mean().clamp_min((1e-3 * least) ** 2)
        design = slope[inliers]
        normal = torch.einsum("nij,nik->jk", design, design) + variance * prior
        scores = (design * error[inliers].unsqueeze(-1)).sum(1)
        change = torch.linalg.solve(normal, scores.sum(0) - variance * prior @ (values - expected))
        values = values + change
        if change.abs().max() < _SETTLED:
            break
    if change.abs().max() > _MOVING:
        raise ValueError(f"too few directions for the fit to converge in {_ROUNDS} rounds: {_SWING}")
    blocks = torch.stack([block.sum(0) for block in scores.tensor_split(_BLOCKS)])
    inverse = torch.linalg.inv(normal)
    covariance = inverse @ (blocks.T @ blocks + variance.square() * prior) @ inverse
    return values[:9].unflatten(0, (3, 3)), values[9:], covariance, float(variance.sqrt()), inliers


def _prior(alignment: float) -> Tensor:
    """Return the inverse of the covariance of mix and offset before the swing: gain, soft iron, a small rotation."""
    swap = torch.eye(9, dtype=torch.float64).unflatten(0, (3, 3)).transpose(0, 1).flatten(0, 1)
    gain = torch.outer(torch.eye(3).flatten(), torch.eye(3).flatten()) / 3
    same, turned = (torch.eye(9) + swap) / 2 - gain, (torch.eye(9) - swap) / 2
    precision = torch.zeros(12, 12, dtype=torch.float64)
    precision[:9, :9] = gain / 3 / GAIN_STD**2 + same / SOFT_IRON_STD**2 + turned / alignment**2
    precision[9:, 9:] = torch.eye(3) / HARD_IRON_STD**2
    return precision


def _remaining_std(mix: Tensor, covariance: Tensor, reference: Tensor) -> Tensor:
    """Return the remaining standard deviations of D, I, B_H ``(3,)``, averaged over headings, roll and pitch."""
    tilts = (0.0, 0.0), (TILT_DEG, 0.0), (-TILT_DEG, 0.0), (0.0, TILT_DEG), (0.0, -TILT_DEG)
    attitude = torch.tensor([(*tilt, 30.0 * turn) for tilt in tilts for turn in range(12)], dtype=torch.float64)
    turn, scale = rotation(attitude), reference.norm()
    moved = torch.linalg.solve(mix, _design(turn.mT @ reference / scale))
    spread = scale * elements_jacobian(reference) @ turn @ moved
    return (spread @ covariance @ spread.mT).mean(0).diagonal().clamp_min(0).sqrt()


# Refusals


def _check_samples(axes: Tensor, total: float) -> None:
    """Raise for too few samples, non-finite ones, or those in another unit."""
    check_tensor(3, axes_nt=axes)
    if axes.ndim != 2 or len(axes) < LEAST_SAMPLES:
        raise ValueError(f"axes_nt must be (N, 3) with at least {LEAST_SAMPLES} samples, got {tuple(axes.shape)}")
    if not axes.isfinite().all():
        row = int((~axes.isfinite().all(-1)).nonzero()[0])
        raise ValueError(f"sample {row + 1} is {axes[row].tolist()}: leave out samples that are not finite")
    lengths = axes.norm(dim=-1)
    check_intensity(float(lengths.median()), total)
    if lengths.std() < 1e-6 * total:
        raise ValueError("all samples have the same length: log the field as measured, not its direction alone")


def _check_axes(axes: Tensor, level: Tensor) -> None:
    """Raise if other axes, or other signs, explain the samples much better than those stated."""
    products = (axes - axes.mean(0)).T @ (level - level.mean(0))
    squares = (axes - axes.mean(0)).square().sum() + (level - level.mean(0)).square().sum()
    choices = [
        torch.eye(3).double()[list(order)] * torch.tensor(signs) for order in permutations(range(3)) for signs in _SIGNS
    ]
    misfits = torch.stack([squares - 2 * (products * choice).sum() for choice in choices])
    best = choices[int(misfits.argmin())]
    if misfits.min() > 0.25 * (squares - 2 * products.trace()):
        return
    names = [("minus " if row.sum() < 0 else "") + _AXES[int(row.abs().argmax())] for row in best]
    raise ValueError(
        f"the axes of the samples fit {', '.join(names)}, and {', '.join(_AXES)} are expected"
        + (": a left-handed frame; change the sign of one axis" if torch.det(best) < 0 else "")
        + ", or the heading is not from true north"
    )


def _check_fit(noise: float, outliers: float, scale: float) -> None:
    """Raise for too many outliers, or residuals that no noise explains."""
    if outliers > MOST_OUTLIERS:
        raise ValueError(
            f"{100 * outliers:.0f} % of the samples deviate by more than {OUTLIER_SIGMAS:g} standard deviations: "
            "leave out the times when loads were switched or iron was near, and swing again"
        )
    if noise > 0.05 * scale:
        raise ValueError(
            f"the samples deviate by {noise:.0f} nT from one field of {scale:.0f} nT: check the place, the times of "
            "samples and attitude, and that the heading is from true north"
        )


def _check_directions(shares: Tensor) -> None:
    """Raise if the field was seen in a plane or along a line alone, with which no ellipsoid can be fitted."""
    least = float(torch.linalg.svdvals(shares - shares.mean(0))[-1]) / math.sqrt(len(shares))
    if least < LEAST_SPREAD:
        raise ValueError(
            f"too few directions for a fit without attitude: in one direction the field changed by {100 * least:.1f} % "
            f"of its strength, where {100 * LEAST_SPREAD:g} % are needed; {_SWING}, or log attitude and true heading"
        )


def _check_std(std: Tensor) -> None:
    """Raise if a calibration leaves more than :data:`MOST_STD`."""
    if (std > torch.tensor(MOST_STD)).any():
        left = "D {:.2g} deg, I {:.2g} deg, B_H {:.3g} nT".format(*std.tolist())
        raise ValueError(f"too few directions, which leave {left}: {_SWING}")

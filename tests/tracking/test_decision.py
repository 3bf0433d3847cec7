"""The decision to declare an arrival, by hand."""

import math

import pytest
import torch
from support.tracks import F64, f64

from magrl.tracking import ELEMENT_SCALES, FieldTrack, approach, arrival_decision

SCALES = f64(*ELEMENT_SCALES)
HERE = f64(0.0, 60.0, 20000.0)


def vehicle(north_km: float, std: float = 0.0) -> tuple[FieldTrack, torch.Tensor]:
    """A track with known gradients and the values at a target northward; I and D change by 1 unit per 100 km."""
    gradient = f64((0.0, 1.0), (1.0, 0.0), (0.0, 0.0))
    mean = torch.cat(((HERE / SCALES).unsqueeze(-1), gradient), -1)
    covariance = torch.diag(f64(max(std, 1e-4) ** 2, 1e-10, 1e-10)).expand(3, 3, 3)
    target = HERE + SCALES * gradient[:, 0] * north_km / 100
    return FieldTrack(mean.unsqueeze(0), covariance.unsqueeze(0)), target.unsqueeze(0)


def decide(north_km: float, std: float, bias: float, left: int = 50, drift: float = 0.0):
    track, target = vehicle(north_km, std)
    noise = tuple(0.1 * scale for scale in ELEMENT_SCALES)
    lasting = (tuple(each * scale for scale in ELEMENT_SCALES) for each in (bias, drift))
    return arrival_decision(track, target, noise, *lasting, torch.tensor([left]), 25.0)


def test_what_a_constant_error_leaves_is_all_that_can_be_attained() -> None:
    """An error of 0.2 units is one of 20 km eastward, by D, and of 10 km northward, however long one reads.

    B_H is the same everywhere and shows its own error, with which that of I is correlated by -sin(60°).
    """
    north = torch.linspace(-25, 25, 2001, dtype=F64)
    inside = torch.special.erf((625 - north.square()).sqrt() / (20 * 2**0.5))
    expected = torch.trapezoid(inside * torch.exp(-((north / 10) ** 2) / 2) / (10 * (2 * math.pi) ** 0.5), north).item()
    for std in (0.0, 0.3):
        assert decide(0.0, std, 0.2).attainable.item() == pytest.approx(expected, abs=0.03)
    done, not_yet = decide(0.0, 0.0, 0.2), decide(0.0, 0.3, 0.2)
    assert done.declare.item()
    assert not not_yet.declare.item()
    assert done.probability > not_yet.probability
    assert decide(0.0, 0.3, 0.2, left=0).declare.item()


def test_readings_average_a_part_of_a_slow_error() -> None:
    """A constant error of 0.1 and a slow one of 0.2, half of whose variance is left: 0.01 + 0.02."""
    found = decide(0.0, 0.0, 0.05**0.5, drift=0.2)
    alike = decide(0.0, 0.0, 0.03**0.5)
    assert found.probability.item() == pytest.approx(alike.probability.item(), rel=1e-6)
    assert found.attainable.item() == pytest.approx(alike.attainable.item(), rel=1e-6)
    assert found.probability > decide(0.0, 0.0, 0.05**0.5).probability + 0.05


@pytest.mark.parametrize(("north_km", "declare"), [(5.0, True), (60.0, False), (400.0, False)])
def test_it_declares_where_it_is_sure_and_goes_on_elsewhere(north_km: float, declare: bool) -> None:
    decision = decide(north_km, 0.0, 0.0)
    assert decision.declare.item() is declare
    assert decision.posterior.way().displacement[0].tolist() == pytest.approx([north_km, 0.0], abs=0.1 * north_km)


def test_a_vehicle_near_the_border_goes_nearer_if_readings_there_help() -> None:
    """20 km away and 10 km unsure: to go there and read costs 5 % of the path, and makes it certain."""
    assert not decide(20.0, 0.1, 0.0).declare.item()


@pytest.mark.parametrize(("bias", "share"), [(0.0, 0.8), (0.2, 0.25)])
def test_it_goes_no_nearer_than_readings_are_worth(bias: float, share: float) -> None:
    """24 km away: one that is sure stops at once; a constant error of 20 km needs the nearest place that it may go to,
    which is not the estimated one, as each new estimate is another way."""
    assert decide(24.0, 0.0, bias).stop_km.item() == pytest.approx(share * 25)


def test_the_approach_turns_where_it_is_if_the_way_is_behind() -> None:
    way = f64((0.0, 30.0), (-30.0, 0.0), (0.0, -80.0))
    action = approach(way, torch.zeros(3, 1, dtype=F64), f64(4.0).expand(3, 1), 50.0, math.pi / 2)
    assert action.tolist() == [pytest.approx(row) for row in ([26, math.pi / 2], [0, math.pi / 2], [50, -math.pi / 2])]

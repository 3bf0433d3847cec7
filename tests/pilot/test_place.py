"""What a vehicle knows: models of the Earth, its place and drift, the anomaly, and a surveyed destination."""

from __future__ import annotations

import math

import pytest
import torch
from support.tracks import f64, randn
from torch import Tensor

from magrl import evaluate
from magrl.envs import Scenario, earth_scenario
from magrl.errors import CONDITIONS
from magrl.field import IGRF
from magrl.field.elements import elements_jacobian, measured_elements
from magrl.geodesy import geodesic, move, move_place
from magrl.pilot import earth, earth_model
from magrl.pilot.anomalies import crust_share
from magrl.pilot.belief import ANOMALY, DRIFT, PLACE, Belief, Motion, at_place, before, moved, read, start
from magrl.pilot.destination import destination, posterior
from magrl.pilot.earth import EarthModel, secular_variance
from magrl.pilot.local import slopes
from magrl.pilot.prior import lasting_covariances
from magrl.pilot.survey import surveyed
from magrl.sensor_std import PERFECT, SensorStd

PLACES = torch.tensor([[50.0, 10.0], [-20.0, 150.0], [70.0, -120.0], [5.0, 179.9]], dtype=torch.float64)


def std_of(*stds: tuple[float, float, float], count: int = len(PLACES)) -> SensorStd:
    given = [torch.tensor(std, dtype=torch.float64).expand(count, 3) for std in (*stds, *[(0.0,) * 3] * 4)]
    return SensorStd(*given[:4])


def test_local_coefficients_have_the_field_and_its_slopes() -> None:
    model = earth_model("IGRF-14", "2025-01-01")
    coefficients = model.coefficients(PLACES)
    torch.testing.assert_close(coefficients[:, :3], model.field(*PLACES.unbind(-1)), rtol=0, atol=1e-6)
    for axis, bearing in enumerate((0.0, math.pi / 2)):
        course, half = (torch.full((len(PLACES),), x, dtype=torch.float64) for x in (bearing, 0.5))
        ends = [model.field(*move(*PLACES.unbind(-1), course + turn, half)) for turn in (0.0, math.pi)]
        torch.testing.assert_close(slopes(coefficients, PLACES)[:, :3, axis], ends[0] - ends[1], rtol=0, atol=0.02)


def test_a_belief_follows_its_model() -> None:
    motion = Motion(earth_model("IGRF-14", "2025-01-01"), drift=0.01, wander_km=0.1)
    belief = at_place(PLACES, 5.0, std_of(), motion)
    for _ in range(4):
        belief = moved(belief, torch.full((4,), 50.0), torch.tensor([1.0, 2.0, -1.0, 3.0]), std_of(), motion)
    torch.testing.assert_close(belief.field, motion.model.field(*belief.place.unbind(-1)), rtol=0, atol=1e-6)
    variance = belief.covariance[:, PLACE, PLACE].diagonal(dim1=-2, dim2=-1).sum(-1)
    expected = 5.0**2 + 2 * (200 * 0.01) ** 2 + 2 * 200 * 0.1**2  # start, drift, wander
    torch.testing.assert_close(variance, torch.full((4,), expected).double(), rtol=0.05, atol=0)  # meridians converge


@pytest.mark.parametrize("latitude", [65.0, -65.0])
def test_an_error_of_the_place_is_carried_as_geodesics_are(latitude: float) -> None:
    """A leg from 1 km to the north or to the east of the place, on the same course, ends where its error does."""
    motion, none = Motion(earth_model("IGRF-14", "2025-01-01")), torch.zeros(4).double()
    course, km = torch.tensor([0.0, 1.0, 2.5, 4.0]).double(), none + 100
    place = torch.tensor([latitude, 20.0]).double().expand(4, 2)
    after, ends = moved(at_place(place, math.sqrt(2), std_of(), motion), km, course, std_of(), motion), []
    for bearing in (none, none + math.pi / 2):
        end = move_place(move_place(place, bearing, none + 1), course, km)
        apart, direction = geodesic(*after.place.unbind(-1), *end.unbind(-1))
        ends.append(apart.unsqueeze(-1) * torch.stack((direction.cos(), direction.sin()), -1))
    step = torch.stack(ends, -1)
    torch.testing.assert_close(after.covariance[:, PLACE, PLACE], step @ step.mT, rtol=0, atol=3e-3)


def test_a_model_without_an_error_leaves_none_of_the_field() -> None:
    """After any leg, where place and drift have none."""
    motion = Motion(EarthModel("exact", IGRF("2025-01-01"), torch.zeros(14).double()))
    after = moved(at_place(PLACES, 0.0, std_of(), motion), *torch.full((2, 4), 50.0), std_of(), motion)
    assert not after.covariance.any()


def test_places_that_are_not_known_have_a_model_of_20_years_at_least(monkeypatch) -> None:
    monkeypatch.setattr(earth, "PLACES", 4)
    five, twenty, forty = (
        EarthModel("model", IGRF("2025-01-01"), secular_variance(years)).cells().covariance
        for years in (5.0, 20.0, 40.0)
    )
    assert torch.equal(five, twenty)
    assert not torch.equal(twenty, forty)


def test_readings_correct_place_and_drift() -> None:
    model = earth_model("IGRF-14", "2025-01-01")
    motion, std = Motion(model, drift=0.05), std_of((0.01, 0.01, 1.0))
    course, distance = torch.tensor([1.0, 2.0, -1.0, 3.0]).double(), torch.full((4,), 50.0).double()
    true, belief = PLACES, at_place(PLACES, 5.0, std, motion)
    for _ in range(8):
        belief = moved(belief, distance, course, std, motion)
        true = torch.stack(move(*true.unbind(-1), course, distance), -1)
        true = torch.stack(move(*true.unbind(-1), torch.zeros(4), torch.full((4,), 2.0)), -1)  # 4 % northward
        belief = read(belief, measured_elements(model.field(*true.unbind(-1))), std.noise)
    assert (geodesic(*true.unbind(-1), *belief.place.unbind(-1))[0] < 2.0).all()
    torch.testing.assert_close(belief.mean[:, DRIFT.start], torch.full((4,), 0.04).double(), rtol=0, atol=0.01)


@pytest.mark.parametrize(("years", "predicted", "fields"), [(20.0, False, (675, 1177)), (5.0, True, (50, 84))])
def test_secular_change(years: float, predicted: bool, fields: tuple[float, float]) -> None:
    """Of IGRF of 2005 and of IGRF-13: in truth 743 and 1310 nT, 48 and 82 nT in 2025, by IGRF-14."""
    variance = secular_variance(years, predicted)
    n = torch.arange(len(variance))
    level, down = (((n + 1) * factor * variance).sum().sqrt().item() for factor in (n / 2, n + 1))
    assert (level, down) == pytest.approx(fields, rel=0.1)


def test_an_old_model_places_a_vehicle_without_a_place() -> None:
    place = torch.tensor([[50.0, 10.0]], dtype=torch.float64)
    reading, std = measured_elements(IGRF("2025-01-01")(*place.unbind(-1))), std_of((0.1, 0.1, 10.0), count=1)
    belief = before(reading, std, model=earth_model("IGRF-2005", "2025-01-01"))
    assert abs(belief.latitude.item() - 50.0) < 3.0
    assert not belief.located.any()


@pytest.mark.parametrize(("drift", "crust"), [((0.2, 0.1, 30.0), 0.0), ((0.0, 0.0, 0.0), 30.0)])
def test_the_anomaly_has_the_stated_effect(drift: tuple[float, float, float], crust: float) -> None:
    field = torch.tensor([15000.0, 3000.0, 40000.0], dtype=torch.float64)
    std = SensorStd(*(torch.tensor(x, dtype=torch.float64) for x in ((0.0,) * 3, drift, drift, (0.0,) * 3)))
    anomaly, jacobian = lasting_covariances(field, std, crust)[1], elements_jacobian(field)
    variance = (jacobian @ anomaly @ jacobian.mT).diagonal()
    expected = torch.tensor(drift, dtype=torch.float64).square() + crust**2 * jacobian.square().sum(-1)
    torch.testing.assert_close(variance, expected, rtol=0.01, atol=0)


def test_a_destination_out_of_reach_is_not_known() -> None:
    field, std = IGRF("2025-01-01"), std_of((0.05, 0.05, 5.0))
    belief = start(measured_elements(field(*PLACES.unbind(-1))), std)

    def seen(distance_km: float) -> Tensor:
        there = move(*PLACES.unbind(-1), torch.zeros(4).double(), torch.full((4,), distance_km).double())
        return posterior(destination(belief, measured_elements(field(*there)), 400.0)).radius(0.9)

    assert (seen(400.0) < 1500.0).all()
    assert (seen(6000.0) > 5000.0).any()


def scenario_of(latitude: float) -> Scenario:
    scenario = earth_scenario(4, 3, max_leg_km=90.0, max_latitude=latitude, distance_range_km=(300.0, 500.0))
    scenario = scenario.replace(max_leg_km=50.0, max_steps=15, arrival="declared", start_heading="random")
    return scenario.with_trips(scenario.random_trips(6, 3))


def test_a_model_and_a_start_beat_dead_reckoning() -> None:
    told = {"trips": scenario_of(70), "errors": "underwater", "model": "IGRF-13", "start_km": 5.0, "seed": 3}
    share = [evaluate(name, **told)["success"].double().mean() for name in ("kalman", "dead_reckoning")]
    assert share[0] > share[1] + 0.15


def test_a_chart_of_declination_corrects_a_compass() -> None:
    told, scenario = {"north": "magnetic", "start_km": 1.0, "seed": 3}, scenario_of(60)
    assert evaluate("dead_reckoning", scenario, model="IGRF-13", **told)["success"].all()
    assert evaluate("dead_reckoning", scenario, **told)["success"].double().mean() < 0.5


def test_the_drift_that_a_vehicle_states() -> None:
    assert CONDITIONS["ship"].motion_std == pytest.approx((0.0276, 0.0), abs=5e-4)
    assert CONDITIONS["laboratory"].motion_std == (0.0, 0.0)
    assert PERFECT.noise == (0.0, 0.0, 0.0)


MODEL, TRUE = earth_model("IGRF-2005", "2025-01-01"), IGRF("2025-01-01")
COUNT, EXACT = 60, f64(0.01, 0.01, 1.0)
ERRORS = SensorStd(*torch.zeros(4, COUNT, 3).double())
STARTS = torch.stack((60 * randn(COUNT).tanh(), 180 * randn(COUNT, seed=1).tanh()), -1)
TARGETS = move_place(STARTS, 3 * randn(COUNT, seed=2), 400 * torch.ones(COUNT).double())


def at_start(start_km: float = 0.01) -> Belief:
    return at_place(STARTS, start_km, ERRORS, Motion(MODEL))


def told(belief: Belief, std: Tensor = EXACT, crust_nt: float = 0.0, errors: SensorStd = ERRORS) -> Belief:
    """The belief with the true elements of the destination."""
    given = measured_elements(TRUE(*TARGETS.unbind(-1)))
    return surveyed(belief, given, std, TARGETS, MODEL, torch.full((COUNT,), crust_nt).double(), errors)


def field_error(belief: Belief) -> Tensor:
    return (belief.field - TRUE(*STARTS.unbind(-1))).norm(dim=-1)


def test_they_show_how_far_the_model_is_off() -> None:
    """A model of 2005 is off by hundreds of nanotesla here; with what is measured 400 km away, by half as much."""
    before, after = at_start(), told(at_start())
    assert field_error(after).square().mean() < 0.25 * field_error(before).square().mean()
    square = (after.field - TRUE(*STARTS.unbind(-1))).unsqueeze(-1)
    square = (square.mT @ torch.linalg.inv(after.covariance[:, :3, :3]) @ square).mean()
    assert 1.5 < square < 4.5  # chi-square of three


@pytest.mark.parametrize("errors", [{"std": 1e6 * EXACT}, {"crust_nt": 1e6}], ids=str)
def test_they_count_by_their_accuracy(errors: dict) -> None:
    before, after = at_start(), told(at_start(), **errors)
    torch.testing.assert_close(after.field, before.field, rtol=1e-4, atol=1.0)
    less = told(at_start(), **{name: 100 / 1e6 * value for name, value in errors.items()})
    variances = [one.covariance[:, :3, :3].diagonal(dim1=1, dim2=2).sum(-1) for one in (told(at_start()), less, before)]
    assert (torch.stack(variances).diff(dim=0) > 0).all()


def test_far_from_the_vehicle_its_crust_is_an_anomaly_there() -> None:
    crust = told(at_start(), crust_nt=300.0)
    given, none = measured_elements(TRUE(*TARGETS.unbind(-1))), torch.zeros(COUNT).double()
    there = surveyed(at_start(), given, EXACT, TARGETS, MODEL, none, ERRORS, there_nt=300.0)
    torch.testing.assert_close(there.mean[:, :3], crust.mean[:, :3], rtol=0.01, atol=0.1)
    assert (there.mean - told(at_start()).mean)[:, :3].norm(dim=-1).max() > 10


def test_at_its_own_place_a_survey_shows_the_field_and_the_anomaly_together() -> None:
    crust, given = torch.full((COUNT,), 300.0).double(), measured_elements(TRUE(*STARTS.unbind(-1)))
    after = surveyed(at_start(), given, EXACT, STARTS, MODEL, crust, ERRORS)
    share = crust_share(after.field, ERRORS, crust)
    rows = torch.zeros_like(after.covariance[:, :3])
    rows[..., :3], rows[..., ANOMALY] = torch.eye(3).double(), share
    assert (rows @ after.covariance @ rows.mT).diagonal(dim1=1, dim2=2).sqrt().max() < 100


def test_declination_counts_neither_by_a_compass_nor_where_it_is_missing() -> None:
    compass = ERRORS._replace(bias=torch.full_like(ERRORS.bias, math.inf))
    given = measured_elements(TRUE(*TARGETS.unbind(-1))).index_fill(-1, torch.tensor([0]), math.nan)
    missing = surveyed(at_start(), given, EXACT, TARGETS, MODEL, torch.zeros(COUNT).double(), ERRORS)
    masked = told(at_start(), errors=compass._replace(bias=f64(math.inf, 0.0, 0.0).expand(COUNT, 3)))
    torch.testing.assert_close(masked.mean, missing.mean)
    torch.testing.assert_close(masked.covariance, missing.covariance)
    assert (missing.field - told(at_start()).field).norm(dim=-1).max() > 1


def test_they_say_nothing_of_the_place() -> None:
    """The error of a coarse start is in the predicted difference, which does not depend on it where the model is
    right."""
    belief = moved(
        at_start(20.0), torch.full((COUNT,), 30.0).double(), torch.ones(COUNT).double(), ERRORS, Motion(MODEL)
    )
    off = geodesic(*told(belief).place.unbind(-1), *belief.place.unbind(-1))[0]
    assert off.max() < 1.0
    scale = belief.covariance[:, PLACE, PLACE].diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(
        told(belief).covariance[:, PLACE, PLACE].diagonal(dim1=-2, dim2=-1), scale, rtol=0.1, atol=0
    )

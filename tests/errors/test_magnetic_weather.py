"""Magnetic weather: the records, where episodes start in them, and what is measured along an episode."""

import math
from collections.abc import Callable

import pytest
import torch
from support.errors import flown, nav
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from magrl.envs import Scenario, named_trips
from magrl.errors import CONDITIONS, Conditions, MagneticWeather
from magrl.evaluation import Flight
from magrl.field import WEATHER, WeatherRecord, weather_record
from magrl.field.elements import field_vector
from magrl.random_numbers import FIRST_RESERVED_SEED

NAN = math.nan
SHIP = CONDITIONS["ship"].speed_km_h


def ship(num_envs: int = 2, **options: object) -> TransformedEnv:
    return TransformedEnv(nav(num_envs), MagneticWeather(**({"speed_km_h": SHIP} | options)))


def ramp(minutes: int = 600) -> WeatherRecord:
    """As many nanotesla northward as minutes, twice as many eastward, and three times downward."""
    return WeatherRecord(torch.arange(float(minutes)).unsqueeze(-1) * torch.tensor([1.0, 2.0, 3.0]))


# Records


def test_records_are_those_of_the_observatories() -> None:
    """Values of the first minute in the file of Boulder, X, Y, Z, less the quiet level.

    In the files of variometers, the length of a horizontal change does not depend on their axes. Since the first
    minute, H, D change from 20873.75, -9.99' to 20804.34, -2.42' at Boulder, and H, E from 12412.33, -445.58 to
    12185.93, -468.71 at College; Z by -21.41 and -244.11.
    """
    for name, minute, across, down in (("boulder-2014", 9687, 83.21, -21.41), ("college", 637, 227.58, -244.11)):
        change = weather_record(name).variation[minute] - weather_record(name).variation[0]
        assert [change[:2].norm().item(), change[2].item()] == pytest.approx([across, down], rel=0, abs=0.11)
    level = torch.tensor([20538.42, 3147.88, 47920.22])  # median of 18 January 2016
    first = torch.tensor([20428.79, 3123.15, 47956.69])
    torch.testing.assert_close(weather_record("quiet").variation[0], first - level, atol=0.06, rtol=0)
    assert {name: len(weather_record(name).variation) for name in WEATHER} == {
        "quiet": 41592,
        "disturbed": 41592,
        "boulder-2016": 41592,
        "boulder-2014": 10080,
        "college": 1440,
    }
    for name in WEATHER:
        assert torch.isfinite(weather_record(name).variation).all()
    assert weather_record("college").variation[:, 0].std() > 2 * weather_record("boulder-2014").variation[:, 0].std()


def test_quiet_and_disturbed_day_have_the_extreme_ranges() -> None:
    """Of the northward component, by day; the first one, after another storm, has nearly the range of the disturbed."""
    days = weather_record("boulder-2016").variation[: 28 * 1440, 0].reshape(-1, 1440)
    daily = days.amax(1) - days.amin(1)
    for name, day in (("quiet", int(daily.argmin())), ("disturbed", int(daily[1:].argmax()) + 1)):
        record = weather_record(name)
        assert (record.first, record.last) == (day * 1440, (day + 1) * 1440 - 1)


def test_an_episode_starts_where_its_whole_span_has_no_gap() -> None:
    variation = torch.zeros(20, 3)
    variation[7, 1] = NAN
    record = WeatherRecord(variation)
    assert record.starts(0).tolist() == [*range(7), *range(8, 20)]
    assert record.starts(6 / 60).tolist() == [0, *range(8, 14)]  # seven minutes, the first and the last included
    assert record.starts(6.5 / 60).tolist() == [*range(8, 13)]
    assert WeatherRecord(variation, first=3, last=9).starts(2 / 60).tolist() == [3, 4, 8, 9]
    with pytest.raises(ValueError, match=r"up to 0.5 h .*'own record'.* at most 0.1 h .*quiet, disturbed"):
        record.starts(0.5)  # 11 minutes follow minute 8
    with pytest.raises(ValueError, match="at most 0 h"):
        WeatherRecord(variation, first=7, last=7).starts(0)


# Along an episode


def test_the_variation_of_the_minute_is_added_to_the_vector() -> None:
    """At 100 km/h, with 60 s for a reading: 10 km take 7 minutes, and standing still one."""
    record = ramp(12000)
    env = ship(record=record, speed_km_h=100.0)
    actions = torch.tensor([[10.0, 0.1], [0.0, 0.0], [50.0, -0.2]]).unsqueeze(1).expand(-1, 2, -1)
    plain = flown(nav(), actions)
    start = None
    for measured, true, minutes in zip(flown(env, actions), plain, (0, 7.0, 8.0, 39.0), strict=True):
        start = measured["weather_clock"][:, 0] if start is None else start
        assert torch.equal(measured["weather_clock"], torch.stack((start, torch.full((2,), minutes).double()), -1))
        minute = (start + minutes).floor()
        variation = field_vector(measured["field"].double()) - field_vector(true["field"].double())
        expected = minute.unsqueeze(-1) * torch.tensor([1.0, 2.0, 3.0])
        torch.testing.assert_close(variation, expected.double(), atol=0.03, rtol=0)
        for key in ("position", "objective", "success", "target_field", "leg", "heading", "done"):
            assert torch.equal(measured[key], true[key]), key
        assert torch.equal(measured["true_field"], true["field"])


def test_elements_by_hand() -> None:
    """400 nT eastward on a field of 300 nT northward: D = atan(4/3), I = atan(500/500), B_H = 500."""
    record = WeatherRecord(torch.tensor([[0.0, 0.0, 0.0], [0.0, 400.0, 500.0]]))
    td = TensorDict(field=torch.tensor([0.0, 0.0, 300.0]), leg=torch.zeros(2))
    weather = MagneticWeather(record, speed_km_h=1.0, span_h=0.0)
    before = weather(td.clone()).set("weather_clock", torch.tensor([1.0, 0.0], dtype=torch.float64))
    measured = weather(before.set("next", td))["next"]
    torch.testing.assert_close(measured["field"], torch.tensor([53.1301, 45.0, 500.0]))
    assert measured["true_field"].tolist() == [0.0, 0.0, 300.0]


def test_the_clock_stops_at_the_span() -> None:
    env = ship(record=ramp(61), speed_km_h=100.0, span_h=1.0)
    states = flown(env, torch.tensor([[40.0, 0.0]] * 4).unsqueeze(1).expand(-1, 2, -1))
    assert [state["weather_clock"][0].tolist() for state in states] == [[0, 0], [0, 25], [0, 50], [0, 60], [0, 60]]


# What a vehicle knows


def test_the_stated_weather_is_that_of_the_longest_trip() -> None:
    """From the quiet day on, a storm comes after two days: 12 nT over 500 km as a ship, 32 nT over 1800 km."""
    stated = []
    for longest, own in ((300.0, {}), (500.0, {}), (1800.0, {}), (1800.0, {"trip_km": 500.0})):
        ship = Conditions("ship", SHIP, {"weather": {"record": "quiet", "span_h": 200.0, **own}})
        scenario = Scenario(distance_range_km=(100.0, longest), trips=named_trips("paper-example"))
        stated.append(Flight(scenario, errors=ship).sensor_std.drift[2])
    assert stated == pytest.approx([12, 12, 32, 12], abs=0.5)


# Errors


MISTAKES: dict[str, Callable[[], object]] = {
    r"24.1 h .*'college'.*23.9 h": lambda: MagneticWeather("college", speed_km_h=SHIP, span_h=24.1),
    "needs span_h": lambda: MagneticWeather(speed_km_h=SHIP)(nav().reset()),
    "trip_km must be .* above 0, got 0": lambda: MagneticWeather(speed_km_h=SHIP, trip_km=0),
    # 50 legs of 50 km at 6.1 km/h take 411 h, and 13 days follow the disturbed one
    r"410.6\d* h .*'disturbed'.* 237.1 h": lambda: ship(speed_km_h=6.1).specs,
    "'boulder-2014', 'college', got 'storm'": lambda: weather_record("storm"),
    r"\(3,\)": lambda: WeatherRecord(torch.zeros(3)),
    r"last .*1": lambda: WeatherRecord(torch.zeros(5, 3), first=2, last=1),
    "surrogates need a record without gaps, 'own record' has some": lambda: WeatherRecord(
        torch.tensor([[0.0, 0.0, NAN]])
    ).surrogates(1),
}


@pytest.mark.parametrize("says", MISTAKES)
def test_mistakes(says: str) -> None:
    with pytest.raises(ValueError, match=says):
        MISTAKES[says]()


# Surrogates


def test_surrogates_do_not_depend_on_the_default_dtype() -> None:
    record = weather_record("college")
    drawn = record.surrogates(2)
    torch.set_default_dtype(torch.float64)
    try:
        assert torch.equal(record.surrogates(2), drawn)
    finally:
        torch.set_default_dtype(torch.float32)


def test_surrogates_have_the_spectra_of_the_record_and_other_phases() -> None:
    """Of each component and of their products; an odd length has no highest frequency that is real."""
    for variation in (weather_record("college").variation, weather_record("college").variation[:-1]):
        record = WeatherRecord(variation)
        drawn = record.surrogates(8, seed=1).double()
        spectrum, found = torch.fft.rfft(variation.double(), dim=0), torch.fft.rfft(drawn, dim=1)
        expected = spectrum.unsqueeze(-1) * spectrum.conj().unsqueeze(-2)
        found = found.unsqueeze(-1) * found.conj().unsqueeze(-2)
        torch.testing.assert_close(found, expected.expand_as(found), rtol=1e-3, atol=1.0)
        correlations = torch.corrcoef(torch.cat((variation.T.double()[:1], drawn[..., 0])))
        assert correlations[~torch.eye(9, dtype=torch.bool)].abs().max() < 0.7


def test_trainings_get_surrogates_and_evaluations_the_record() -> None:
    """By the seed of the environment, also where it is set later."""
    env, record = ship(64, surrogates=3), weather_record("disturbed")
    length = len(record.variation)
    for seed, training in ((7, True), (FIRST_RESERVED_SEED, False), (8, True)):
        env.set_seed(seed)
        start = env.reset()["weather_clock"][:, 0]
        assert ((start >= length) == training).all()
        assert ((start % length >= record.first) & (start % length <= record.last)).all()
        assert len((start // length).unique()) == (3 if training else 1)
    assert len(ship(1).transform.variation) == length

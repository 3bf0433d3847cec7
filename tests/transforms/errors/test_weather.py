"""Magnetic weather: the records, where episodes start in them, and what is measured along an episode."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial

import pytest
import torch
from support.conformance import Conformance
from support.environments import parallel
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.evaluation import evaluation_rollout
from magrl.field import WEATHER, FieldModel, WeatherRecord, weather_record
from magrl.field.elements import field_vector
from magrl.navigators import Secant
from magrl.transforms import SPEEDS_KM_H, FieldGradient, GradientHeading, MagneticWeather, SensorNoise

NAN = math.nan
SHIP = SPEEDS_KM_H["ship"]


@cache
def field() -> FieldModel:
    return Scenario().build_field()


def nav(num_envs: int = 2, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(field=field()), num_envs=num_envs, **({"seed": 0} | options))


def ship(num_envs: int = 2, **options: object) -> TransformedEnv:
    return TransformedEnv(nav(num_envs), MagneticWeather(**({"speed_km_h": SHIP} | options)))


def ramp(minutes: int = 600) -> WeatherRecord:
    """As many nanotesla northward as minutes, twice as many eastward, and three times downward."""
    return WeatherRecord(torch.arange(float(minutes)).unsqueeze(-1) * torch.tensor([1.0, 2.0, 3.0]))


# Records


def ranges(name: str) -> Tensor:
    """The range of the northward component on each whole day of a record [nT]."""
    variation = weather_record(name).variation[:, 0]
    days = variation[: len(variation) // 1440 * 1440].reshape(-1, 1440)
    return days.amax(1) - days.amin(1)


def test_records_are_those_of_the_observatories() -> None:
    """Values of the first minute in the file of Boulder, X, Y, Z, less the quiet level."""
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
    daily = ranges("boulder-2016")
    assert int(daily.argmin()) + 1 == 18
    assert int(daily[1:].argmax()) + 2 == 20  # the first day, after another storm, has nearly the same range
    days = {name: (weather_record(name).first, weather_record(name).last) for name in ("quiet", "disturbed")}
    assert days == {"quiet": (17 * 1440, 18 * 1440 - 1), "disturbed": (19 * 1440, 20 * 1440 - 1)}
    quiet = weather_record("quiet").variation[17 * 1440 : 18 * 1440]
    torch.testing.assert_close(quiet.median(0).values, torch.zeros(3), atol=0.1, rtol=0)


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


def test_errors_of_records() -> None:
    with pytest.raises(ValueError, match=r"'storm'.*quiet, disturbed, boulder-2016, boulder-2014, college"):
        weather_record("storm")
    with pytest.raises(ValueError, match=r"\(3,\)"):
        WeatherRecord(torch.zeros(3))
    with pytest.raises(ValueError, match=r"first .*5"):
        WeatherRecord(torch.zeros(5, 3), first=5)
    with pytest.raises(ValueError, match=r"last .*1"):
        WeatherRecord(torch.zeros(5, 3), first=2, last=1)


# Conformance


def chain() -> Transform:
    return Compose(
        FieldGradient(field()), GradientHeading(), MagneticWeather(speed_km_h=SHIP), SensorNoise((0.05, 0.05, 5.0))
    )


CASES: dict[str, Callable[[], Transform]] = {
    "ship": partial(MagneticWeather, speed_km_h=SHIP),
    "own record": lambda: MagneticWeather(ramp(), speed_km_h=500.0),
    "chain": chain,
}


@pytest.mark.parametrize("base", [nav])
@pytest.mark.parametrize("make", CASES.values(), ids=CASES.keys())
class TestConformance(Conformance):
    test_trans_serial_env_check = None  # a batch of environments has no step limit, from which a span follows


def test_a_step_in_another_process_starts_from_the_clock_that_it_is_sent() -> None:
    env = parallel(ship)
    try:
        check_env_specs(env)
        state = env.rand_action(env.reset())
        after = [env.step(state.clone())["next"].clone() for _ in range(3)]
        for key in ("weather_clock", "field"):
            assert torch.equal(after[0][key], after[1][key])
            assert torch.equal(after[0][key], after[2][key])
    finally:
        env.close()


# Along an episode


def flown(env: EnvBase, actions: Tensor) -> list[TensorDictBase]:
    states = [env.reset()]
    for action in actions:
        states.append(step_mdp(env.step(states[-1].clone().set("action", action))))
    return states


def test_the_variation_of_the_minute_is_added_to_the_vector() -> None:
    """At 100 km/h, with 90 s for a reading: 10 km take 7.5 minutes, and standing still 1.5."""
    record = ramp(12000)
    env = ship(record=record, speed_km_h=100.0, reading_s=90.0)
    actions = torch.tensor([[10.0, 0.1], [0.0, 0.0], [50.0, -0.2]]).unsqueeze(1).expand(-1, 2, -1)
    plain = flown(nav(), actions)
    start = None
    for measured, true, minutes in zip(flown(env, actions), plain, (0, 7.5, 9.0, 40.5), strict=True):
        start = measured["weather_clock"][:, 0] if start is None else start
        assert torch.equal(measured["weather_clock"], torch.stack((start, torch.full((2,), minutes).double()), -1))
        minute = (start + minutes).floor()
        variation = field_vector(measured["field"].double()) - field_vector(true["field"].double())
        expected = minute.unsqueeze(-1) * torch.tensor([1.0, 2.0, 3.0])
        torch.testing.assert_close(variation, expected.double(), atol=0.03, rtol=0)
        for key in ("position", "objective", "success", "target_field", "move", "heading", "done"):
            assert torch.equal(measured[key], true[key]), key
        assert torch.equal(measured["true_field"], true["field"])


def test_elements_by_hand() -> None:
    """400 nT eastward on a field of 300 nT northward: D = atan(4/3), I = atan(500/500), B_H = 500."""
    record = WeatherRecord(torch.tensor([[0.0, 0.0, 0.0], [0.0, 400.0, 500.0]]))
    td = TensorDict(field=torch.tensor([0.0, 0.0, 300.0]), move=torch.zeros(2))
    td["weather_clock"] = torch.tensor([0.0, 1.9], dtype=torch.float64)
    measured = MagneticWeather(record, speed_km_h=1.0, span_h=0.0)(td)
    torch.testing.assert_close(measured["field"], torch.tensor([53.1301, 45.0, 500.0]))
    assert measured["true_field"].tolist() == [0.0, 0.0, 300.0]


def test_without_variation_the_elements_stay() -> None:
    still = WeatherRecord(torch.zeros(20000, 3))
    env = ship(20, record=still)
    td, expected = env.rollout(5, Secant()), nav(20).rollout(5, Secant())
    torch.testing.assert_close(td["next", "field"], expected["next", "field"], rtol=1e-6, atol=1e-5)


def test_the_clock_stops_at_the_span() -> None:
    env = ship(record=ramp(61), speed_km_h=100.0, reading_s=0.0, span_h=1.0)
    states = flown(env, torch.tensor([[40.0, 0.0]] * 4).unsqueeze(1).expand(-1, 2, -1))
    assert [state["weather_clock"][0].tolist() for state in states] == [[0, 0], [0, 24], [0, 48], [0, 60], [0, 60]]


def test_guidance_before_the_weather_knows_none_of_it() -> None:
    guidance = FieldGradient(field()), GradientHeading()
    plain = TransformedEnv(nav(5), Compose(*guidance)).reset()
    state = TransformedEnv(nav(5), chain()).reset()
    assert torch.equal(state["gradient_heading"], plain["gradient_heading"])
    assert torch.equal(state["true_field"], plain["field"])  # neither weather nor noise
    assert not torch.equal(state["field"], plain["field"])


# Starts


def starts(env: EnvBase) -> Tensor:
    return env.reset()["weather_clock"][:, 0]


def test_starts_are_even_over_the_day() -> None:
    drawn = starts(ship(20000, span_h=48.0)) - 19 * 1440
    assert drawn.min() >= 0
    assert drawn.max() <= 1439
    counts = torch.histc(drawn.float(), 24, 0, 1440)
    assert ((counts - 20000 / 24).square() / (20000 / 24)).sum() < 49.7  # chi-squared of 23, p = 0.001


def test_starts_are_a_function_of_seed_vehicle_and_episode() -> None:
    few, many = ship(3), ship(50)
    first, second = starts(few), starts(few)
    assert torch.equal(first, starts(many)[:3])
    assert torch.equal(second, starts(many)[:3])
    assert not torch.equal(first, second)
    assert not torch.equal(starts(ship(3, seed=1)), first)
    few.transform.restart()
    assert torch.equal(starts(few), first)


def test_partial_reset_starts_an_episode_and_leaves_the_others_alone() -> None:
    env, whole = ship(4), ship(4)
    expected = torch.stack((starts(whole), starts(whole)))
    td = step_mdp(env.rollout(3, break_when_any_done=False)[:, -1])
    kept, chosen = td.clone(), torch.tensor([False, True, True, False])
    after = env.reset(td.set("_reset", chosen.unsqueeze(-1)))
    for key in ("field", "true_field", "weather_clock"):
        assert torch.equal(after[key][~chosen], kept[key][~chosen]), key
    assert torch.equal(after["weather_clock"][:, 0], torch.where(chosen, expected[1], expected[0]))
    assert after["weather_clock"][chosen, 1].eq(0).all()


def test_state_holds_the_episodes() -> None:
    env, other = ship(3), ship(3)
    for _ in range(3):
        env.reset()
    other.load_state_dict(env.state_dict())
    assert torch.equal(starts(other), starts(env))


# Policies and errors


def test_a_navigator_reads_what_is_measured() -> None:
    states = evaluation_rollout(ship(4), Secant())[:, :5]

    def actions(change: Callable[[TensorDictBase], object]) -> Tensor:
        navigator, moves = Secant(), []
        for state in states.unbind(1):
            change(state := state.clone())
            moves.append(navigator(state)["action"])
        return torch.stack(moves)

    plain = actions(lambda _: None)
    assert torch.equal(actions(lambda state: state["true_field"].fill_(NAN)), plain)
    assert torch.equal(actions(lambda state: state["weather_clock"].fill_(NAN)), plain)
    assert not torch.equal(actions(lambda state: state["field"].mul_(1.01)), plain)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: MagneticWeather(speed_km_h=0), "speed_km_h .*0"),
        (lambda: MagneticWeather(speed_km_h=-5.0), "speed_km_h .*-5.0"),
        (lambda: MagneticWeather(speed_km_h=SHIP, reading_s=-1), "reading_s .*-1"),
        (lambda: MagneticWeather("storm", speed_km_h=SHIP), "'storm'.*quiet, disturbed"),
        (lambda: MagneticWeather("college", speed_km_h=SHIP, span_h=24.1), r"24.1 h .*'college'.*23.9 h"),
        (lambda: MagneticWeather(speed_km_h=SHIP, in_keys=["field"]), r"\['field'\]"),
        (lambda: MagneticWeather(speed_km_h=SHIP)._limits(), "needs span_h"),
        # 50 moves of 50 km at 6.1 km/h take 411 h, and 13 days follow the disturbed one
        (lambda: ship(speed_km_h=SPEEDS_KM_H["underwater"]).specs, r"410.6\d* h .*'disturbed'.* 237.1 h"),
    ],
)
def test_errors(make: Callable[[], object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make()


def test_other_environments_need_a_span() -> None:
    with pytest.raises(KeyError, match=r"'weather_clock'.*reset"):
        ship().step(nav().reset().set("action", torch.zeros(2, 2)))
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\)"):
        _ = ship(in_keys=["move", "move"]).specs

"""Errors of sensors: their levels, by hand and by their statistics; spikes; errors of a vector magnetometer."""

import math
from collections.abc import Callable

import pytest
import torch
from scipy import stats
from support.errors import actions, flown, nav, sensor_errors, under
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

from magrl.errors import SensorErrors, Spikes, VectorErrors, sensor_levels
from magrl.errors.sensors import DRIFT_KM
from magrl.field.elements import field_vector
from magrl.navigators import Secant, policy_env
from magrl.sensor_std import OUTAGE_STD, STD_KEYS, SensorStd

F64 = torch.float64


def test_constant_errors_by_hand() -> None:
    errors = SensorErrors(bias=(0.1, -0.2, 30.0), scale=(0.0, 0.0, 0.01), resolution=(0.0, 0.5, 0.0), fixed=True)
    for state in flown(TransformedEnv(nav(), errors), actions(2, 2)):
        true = state["true_field"]
        expected = true * torch.tensor([1, 1, 1.01]) + torch.tensor([0.1, -0.2, 30.0])
        expected[:, 1] = (2 * expected[:, 1]).round() / 2
        torch.testing.assert_close(state["field"], expected)
        slow = 0.1, 0.2, math.hypot(30.0, 0.01 * 24000)
        torch.testing.assert_close(state["bias_std"][0], torch.tensor(slow))
        torch.testing.assert_close(state["sensor_std"][0], torch.tensor([0.0, 0.5 / math.sqrt(12), 0.0]))


def test_drift_is_stationary_and_forgets_with_the_path() -> None:
    count = 4000
    env = TransformedEnv(nav(count), SensorErrors((0.0,) * 3, drift=(0.1, 0.2, 30.0), drift_length=40.0))
    step = torch.tensor([[[20.0, 0.1]], [[0.0, 0.0]], [[20.0, 1.0]]]).expand(-1, count, -1)
    named = [env.transform.named(state["sensor_error"]) for state in flown(env, step)]
    drift = torch.stack([errors["drift"] for errors in named]) / torch.tensor([0.1, 0.2, 30.0])
    torch.testing.assert_close(drift.std(1), torch.ones(4, 3), atol=0.05, rtol=0)
    assert torch.equal(drift[1], drift[2])  # no path, no change
    for later, correlation in ((1, math.exp(-0.5)), (3, math.exp(-1))):
        found = torch.stack([torch.corrcoef(drift[[0, later], :, k])[0, 1] for k in range(3)])
        torch.testing.assert_close(found, torch.full((3,), correlation), atol=0.05, rtol=0)


def test_an_outage_repeats_the_last_reading() -> None:
    env = TransformedEnv(nav(2000), SensorErrors((0.05, 0.05, 5.0), outage_rate=0.3))
    states = flown(env, actions(3, 2000))
    missing = [state["sensor_std"].eq(OUTAGE_STD).all(-1) for state in states]
    assert not missing[0].any()
    for before, after, lost in zip(states[:-1], states[1:], missing[1:], strict=True):
        assert lost.double().mean() == pytest.approx(0.3, abs=0.05)
        assert torch.equal(after["field"][lost], before["field"][lost])
        assert (after["field"][~lost] != before["field"][~lost]).all()
        torch.testing.assert_close(
            after["sensor_std"][~lost], torch.tensor((0.05, 0.05, 5.0)).expand(int((~lost).sum()), 3)
        )


def test_drift_by_steps_without_a_leg() -> None:
    errors = SensorErrors(drift=(1.0, 1.0, 1.0), drift_length=2.0, in_keys=["field"])
    before, after = flown(TransformedEnv(nav(4000), errors), torch.zeros(1, 4000, 2))
    pair = torch.stack([errors.named(state["sensor_error"])["drift"][:, 0] for state in (before, after)])
    assert torch.corrcoef(pair)[0, 1].item() == pytest.approx(math.exp(-0.5), abs=0.05)


# Spikes, and errors that the vehicle is not told of


def test_spikes_are_rare_large_and_not_told() -> None:
    """They are independent of the reading before, and of each other."""
    states = torch.stack(flown(under(Spikes((2.0, 0.0, 100.0), rate=0.2, seed=1), num_envs=500), actions(9, 500)))
    error = (states["field"] - states["true_field"]).flatten(0, 1)
    hit = (error != 0).any(-1)
    assert hit.double().mean() == pytest.approx(0.2, abs=0.02)
    torch.testing.assert_close(error[hit].std(0), torch.tensor([2.0, 0.0, 100.0]), rtol=0.1, atol=0)
    both = hit.reshape(10, 500).double()
    assert (both[1:] * both[:-1]).mean() == pytest.approx(0.04, abs=0.01)
    assert all(states[key].eq(0).all() for key in STD_KEYS)
    with pytest.raises(ValueError, match=r"rate must be .*got 2"):
        Spikes((1.0,), rate=2)


def test_the_accuracy_that_is_stated_replaces_the_true_one() -> None:
    """And changes nothing else."""
    told = SensorStd((0.05, 0.05, 5.0), drift=(0.0, 0.0, 1.0))
    true, stated = (under(sensor_errors(**options)).reset() for options in ({}, {"stated": told}))
    assert torch.equal(true["field"], stated["field"])
    assert true["bias_std"].ne(0).all()
    for key, std in zip(STD_KEYS, told, strict=True):
        torch.testing.assert_close(stated[key], torch.tensor([std, std]))


# Vector magnetometers


def measured(elements: tuple[float, ...], heading_deg: float, **errors: object) -> list[float]:
    vector = VectorErrors(**errors, fixed=True)
    heading = torch.tensor([math.radians(heading_deg)], dtype=F64)
    return vector.disturb(
        torch.tensor(elements, dtype=F64), heading, vector.constants(torch.zeros(14).double())
    ).tolist()


@pytest.mark.parametrize(
    ("heading", "errors", "expected"),
    [
        (0, {"hard_iron_nt": (100, 0, 0)}, (5, 0, 20100)),  # along magnetic north
        (90, {"hard_iron_nt": (100, 0, 0)}, (5 + math.degrees(math.atan(0.005)), 0, math.hypot(20000, 100))),
        (0, {"hard_iron_nt": (0, 0, 200)}, (5, math.degrees(math.atan(0.01)), 20000)),
        (0, {"soft_iron": ((0.01, 0, 0), (0, 0, 0), (0, 0, 0))}, (5, 0, 20200)),
        (90, {"soft_iron": ((0.01, 0, 0), (0, 0, 0), (0, 0, 0))}, (5, 0, 20000)),
    ],
)
def test_iron_by_hand(heading: float, errors: dict, expected: tuple[float, ...]) -> None:
    """D = 5, I = 0, B_H = 20000: the heading is counted from magnetic north."""
    assert measured((5, 0, 20000), heading + 5, **errors) == pytest.approx(expected, abs=1e-9)


def test_attitude_by_hand() -> None:
    """I = 60: roll turns D by tan(I) times the angle on a heading to magnetic north, and I on one across it."""
    turned = math.degrees(math.atan(math.sin(math.radians(1)) * math.tan(math.radians(60))))
    declination, inclination, _ = measured((0, 60, 20000), 0, attitude_deg=(1, 0))
    assert (declination, round(turned, 4)) == (pytest.approx(-turned), 1.7314)
    assert inclination == pytest.approx(60, abs=0.02)
    total = 20000 / math.cos(math.radians(60))
    across = 0, 59, total * math.cos(math.radians(59))
    assert measured((0, 60, 20000), 90, attitude_deg=(1, 0)) == pytest.approx(across)
    assert measured((0, 60, 20000), 0, attitude_deg=(0, 1)) == pytest.approx(across)


def test_variance_of_a_vector_is_that_of_its_errors() -> None:
    vector = VectorErrors((60.0,) * 3, ((2e-3,) * 3,) * 3, (0.1, 0.1))
    draw = torch.Generator().manual_seed(0)
    constants = vector.constants(torch.randn(100_000, 14, generator=draw, dtype=F64))
    elements = torch.tensor([8.0, 50.0, 30000.0], dtype=F64)
    heading = 6.28 * torch.rand(100_000, 1, generator=draw, dtype=F64)
    error = vector.disturb(elements.expand(100_000, 3), heading, constants) - elements
    torch.testing.assert_close(error.var(0), vector.variance(elements), rtol=0.02, atol=0)


def test_the_constant_part_is_the_mean_error_over_the_headings() -> None:
    """In the vehicle's axes: hard iron, and the vertical field as soft iron and an error of the attitude turn it."""
    vector, draw = VectorErrors((60.0,) * 3, ((2e-3,) * 3,) * 3, (0.2, 0.2)), torch.Generator().manual_seed(0)
    constants = vector.constants(torch.randn(20_000, 14, generator=draw, dtype=F64))
    elements = torch.tensor([8.0, 50.0, 30000.0], dtype=F64)
    mean = torch.zeros(20_000, 3, dtype=F64)
    for heading in torch.arange(8, dtype=F64).unsqueeze(-1) * math.pi / 4:
        for sign, read in ((1, vector.disturb(elements.expand(20_000, 3), heading, constants)), (-1, elements)):
            mean += sign / 8 * field_vector(read - torch.tensor([1.0, 0.0, 0.0]) * torch.rad2deg(heading))
    torch.testing.assert_close(mean.std(0), vector.constant_std(elements), rtol=0.02, atol=0)


def test_noise_is_white_and_normal() -> None:
    """Along vehicles, episodes and readings."""
    noise = SensorErrors((1.0, 1.0, 1.0), in_keys=["field"])
    data = TensorDict(field=torch.zeros(50_000, 3, dtype=F64), batch_size=[50_000])
    first, second = noise(data.clone()), noise(data.clone())["field"]
    third = noise(first.clone().set("next", data.clone()))["next", "field"]
    drawn = first["field"]
    torch.testing.assert_close(drawn.std(0), torch.ones(3, dtype=F64), atol=0.014, rtol=0)
    for element in drawn.unbind(-1):
        assert stats.kstest(element, "norm").pvalue > 1e-3
    joint = torch.cat((drawn[1:], drawn[:-1], second[1:], third[1:]), -1)
    assert torch.corrcoef(joint.T).triu(1).abs().max() < 4.5 / math.sqrt(50_000)


def test_without_noise_the_reading_is_the_value_to_the_bit() -> None:
    td, expected = (policy_env(env, Secant()).rollout(3, Secant()) for env in (under(SensorErrors()), nav()))
    assert torch.equal(td["next", "field"], expected["next", "field"])
    assert torch.equal(td["action"], expected["action"])


def test_levels_by_hand() -> None:
    #    none  common  own factors  D poor  by, then of the bias: none  common  own factors
    uniform = torch.tensor(
        [
            [0.1499, 0.0, 0.5, 0.5, 0.5, 0.0, 0.5, 0.5, 0.0, 0.5, 0.5, 0.5],  # perfect sensors, bias
            [0.15, 0.5 ** (2 / 3), 0.5, 0.5, 0.5, 0.3, 0.5, 0.5, 0.625, 0.0, 1.0, 0.5],  # a tenth of the largest
            [0.99, 1.0, 0.0, 1.0, 0.5, 0.9, 0.5, 0.49, 0.0, 0.5, 0.5, 0.5],  # a hundredth, factors 0.398, 2.512, 1
            [0.99, 0.0, 0.5, 0.5, 0.5, 0.29, 0.5, 0.0, 0.0, 0.5, 0.5, 0.5],  # a poor north reference: 1 + 6 / 2
        ],
        dtype=F64,
    )
    factor = 10**0.4
    expected = [
        [0, 0, 0, 0.35, 0.05, 45.0],
        [0.02, 0.02, 2.0, 0.035 / factor, 0.005 * factor, 4.5],
        [0.002 / factor, 0.002 * factor, 0.2, 0, 0, 0],
        [0.8, 0.2, 20, 0, 0, 0],
    ]
    torch.testing.assert_close(sensor_levels(uniform), torch.tensor(expected, dtype=F64))
    uniform[1, 1] = 0.5
    torch.testing.assert_close(sensor_levels(uniform, 1.0), torch.tensor(expected, dtype=F64))


def noisy(bias: float) -> Callable[[Tensor], Tensor]:
    """Levels of random noise in silence, or with one bias."""

    def levels(uniform: Tensor) -> Tensor:
        return torch.cat((sensor_levels(uniform)[..., :3], torch.full_like(uniform[..., :3], bias)), -1)

    return levels


def test_random_noise_has_the_level_of_its_episode() -> None:
    env = under(SensorErrors(levels=noisy(0.0), seed=3), num_envs=2000)
    td = torch.stack([s.select("field", "true_field", "sensor_std") for s in flown(env, actions(6, 2000))])
    std = td["sensor_std"]
    assert torch.equal(std, std[:1].expand_as(std))
    silent = (std == 0).all(-1)
    assert silent[0].double().mean() == pytest.approx(0.15, abs=0.03)
    assert torch.equal(td["field"][silent], td["true_field"][silent])
    loud = std[..., 2] > 0.05  # above the rounding of float32
    z = ((td["field"] - td["true_field"])[..., 2] / std[..., 2])[loud]
    assert stats.kstest(z.double(), "norm").pvalue > 1e-3
    again = env.reset()["sensor_std"]
    assert ((again != std[0]).any(-1) | (again == 0).all(-1)).double().mean() > 0.95


def test_the_bias_is_partly_constant_and_as_large_as_told() -> None:
    """Their correlation along the path is that of a half that is constant and a half that drifts."""
    env = under(SensorErrors(levels=noisy(30.0), seed=3), num_envs=4000)
    keys = ("field", "true_field", "bias_std", "sensor_std", "leg")
    td = torch.stack([state.select(*keys) for state in flown(env, actions(9, 4000))])
    assert (td["bias_std"] == 30).all()
    silent = (td["sensor_std"][0] == 0).all(-1)
    error, moved = (td["field"] - td["true_field"])[:, silent, 2] / 30, td["leg"][:, silent, 0].cumsum(0)
    assert error.std() == pytest.approx(1.0, rel=0.06)
    expected = 0.5 + 0.5 * torch.exp(-moved / DRIFT_KM)  # shares are uniform
    torch.testing.assert_close((error * error[0]).mean(-1), expected.mean(-1), rtol=0, atol=0.15)


def test_own_levels_add_to_the_sizes() -> None:
    """By numbers which are not those of the readings."""

    def levels(uniform: Tensor) -> Tensor:
        first = uniform[..., :1]
        return torch.cat((first, first + 1, 0 * first, 4 * first, *[0 * first] * 2), -1)

    state = under(SensorErrors((0.0, 0.0, 3.0), bias=(3.0, 0.0, 0.0), levels=levels), num_envs=1000).reset()
    std = state["sensor_std"]
    torch.testing.assert_close(std[:, 1] - std[:, 0], torch.ones(1000))
    assert std[:, 2].eq(3).all()
    torch.testing.assert_close(state["bias_std"][:, 0], torch.hypot(torch.tensor(3.0), 4 * std[:, 0]))
    std = torch.hypot(std, state["bias_std"])
    z = (state["field"] - state["true_field"])[:, :2] / std[:, :2]
    assert torch.corrcoef(torch.cat((z, std[:, :1]), -1).T).triu(1).abs().max() < 4.5 / math.sqrt(1000)

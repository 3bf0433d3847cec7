"""The observation of policies with a memory of their own: by hand on a field with constant gradients."""

import math

import torch
from tensordict import TensorDict
from torch import Tensor

from magrl.transforms import ReadingObservation
from magrl.transforms.sequences import features

GRADIENT = torch.tensor([[0.01, -0.002], [0.004, 0.008], [3.0, -5.0]])  # D, I [deg/km], B_H [nT/km]; north, east
START, DISPLACEMENT = torch.tensor([3.0, 60.0, 20000.0]), torch.tensor([120.0, -200.0])


def flight(heading: float, km: float, **accuracy: Tensor) -> TensorDict:
    """The observations at a start and after a leg."""
    there = {"target_field": (START + GRADIENT @ DISPLACEMENT)[None], "heading": torch.tensor([[heading]]), **accuracy}
    leg = km * torch.tensor([math.cos(heading), math.sin(heading)])
    first = TensorDict(field=START[None], leg=torch.zeros(1, 2), **there, batch_size=1)
    after = TensorDict(field=(START + GRADIENT @ leg)[None], leg=torch.tensor([[km, 0.3]]), **there)
    observe = ReadingObservation([*ReadingObservation.default_in_keys, *accuracy])
    return observe(observe(first).set("next", after))


def nanotesla(change: Tensor, at: Tensor) -> Tensor:
    """D, I and B_H as lengths of the field's vector across, along and in the magnetic meridian."""
    total = at[2] / torch.cos(torch.deg2rad(at[1]))
    return torch.deg2rad(change) * torch.stack((at[2], total, torch.rad2deg(torch.tensor(1.0))))


def test_the_features_by_hand() -> None:
    """A total intensity of 50 000 nT; differences of 1500, -750 and 15 000 nT, of which the last is limited."""
    reading, degree = torch.tensor([30.0, 60.0, 25000.0]), math.degrees(1) / 25000
    target = reading + torch.tensor([1500 * degree, -750 * degree / 2, 15000.0])
    expected = [3**0.5 / 2, 0.5, 0.5, 3**0.5 / 2, 0.0, 1 / 3, 1.0, -0.5, 6.0, 1.0, 0.5, 6.0]
    torch.testing.assert_close(features(reading, target), torch.tensor(expected), rtol=1e-4, atol=1e-4)


def test_a_start_has_no_change() -> None:
    first = flight(0.5, 20.0)["observation"][0]
    assert torch.equal(first[:12], features(START, START + GRADIENT @ DISPLACEMENT))
    assert not first[12:17].any()
    torch.testing.assert_close(first[17:20], torch.tensor([math.cos(0.5), math.sin(0.5), 0.0]))


def test_the_change_of_the_reading_is_along_the_leg() -> None:
    for heading in (0.5, -2.0):
        step = flight(heading, 20.0)["next"]
        seen, at = step["observation"][0], step["field"][0]
        direction = torch.tensor([math.cos(heading), math.sin(heading)])
        rate = nanotesla(GRADIENT @ direction, at)
        torch.testing.assert_close(torch.sinh(seen[12:15]) * 1.25, rate, rtol=1e-3, atol=1e-3)
        left = nanotesla(step["target_field"][0] - at, at)
        torch.testing.assert_close(seen[16], torch.nn.functional.cosine_similarity(rate, left, 0), rtol=1e-2, atol=0)
        nearest_km = torch.dot(rate, left) / rate.square().sum()
        torch.testing.assert_close(400 * torch.sinh(seen[15]), nearest_km, rtol=0.05, atol=0)
        torch.testing.assert_close(seen[17:20], torch.tensor([*direction, 0.4]))


def test_the_accuracy_is_observed_in_nanotesla() -> None:
    """5 nT across, along and in the meridian are 1 unit; sensors that are not described are perfect."""
    assert not flight(0.5, 20.0)["observation"][:, 20:].any()
    unit = 5 / nanotesla(torch.ones(3), START)
    noise, bias = unit[None], torch.tensor([[0.0, 0.0, 1e4]])
    seen = flight(0.5, 20.0, sensor_std=noise, bias_std=bias)["observation"][0, 20:]
    expected = torch.tensor([*[math.asinh(1)] * 3, 0.0, 0.0, 6.0])
    torch.testing.assert_close(seen, expected, rtol=1e-3, atol=1e-3)


def test_another_distance_has_the_same_rate() -> None:
    near, far = (flight(0.5, km)["next", "observation"][0, 12:15] for km in (2.0, 40.0))
    torch.testing.assert_close(near, far, rtol=0.05, atol=0.02)

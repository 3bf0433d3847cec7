"""The counter-based generator of random numbers."""

import math

import pytest
import torch

from magrl.random_numbers import counter_uniform


@pytest.fixture(scope="module", params=[7, -1], ids="seed {}".format)
def uniform(request):
    """100 000 numbers: 1000 vehicles, 20 episodes, 5 draws."""
    rows = torch.cartesian_prod(torch.arange(1000), torch.arange(20)).reshape(1000, 20, 2)
    return counter_uniform(request.param, rows, 5)


def test_uniform_numbers_fill_the_unit_interval(uniform):
    """Mean, variance and a hundred bins of 1e5 numbers, each within what chance allows once in ten thousand."""
    assert uniform.dtype == torch.float64
    assert uniform.shape == (1000, 20, 5)
    assert uniform.min() >= 0
    assert uniform.max() < 1
    count = uniform.numel()
    assert abs(float(uniform.mean()) - 1 / 2) < 4 * math.sqrt(1 / 12 / count)
    assert abs(float(uniform.var()) - 1 / 12) < 4 * math.sqrt(1 / 180 / count)
    bins = torch.histc(uniform, 100, 0, 1)
    chi2 = float(((bins - count / 100) ** 2 / (count / 100)).sum())
    assert abs(chi2 - 99) < 4 * math.sqrt(2 * 99)


def test_neighboring_streams_are_uncorrelated(uniform):
    for dimension, name in enumerate(("vehicles", "episodes", "draws")):
        size = uniform.shape[dimension]
        here, next_ = (uniform.narrow(dimension, start, size - 1).flatten() for start in (0, 1))
        correlation = float(torch.corrcoef(torch.stack((here, next_)))[0, 1])
        assert abs(correlation) < 4 / math.sqrt(len(here)), name


def test_numbers_depend_on_the_row_alone():
    rows = torch.randint(-(2**62), 2**62, (2, 3, 4, 2), generator=torch.Generator().manual_seed(4))
    together = counter_uniform(5, rows, 6)
    assert together.shape == (2, 3, 4, 6)
    flat = counter_uniform(5, rows.reshape(-1, 2).flip(0), 6).flip(0)
    assert torch.equal(together.reshape(-1, 6), flat)
    assert torch.equal(together[1, 2, 3], counter_uniform(5, rows[1, 2, 3], 6))
    assert torch.equal(together[..., :2], counter_uniform(5, rows, 2))


def splitmix_finalizer(value):
    """The published mixing step, on Python integers."""
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) % 2**64
    return value ^ (value >> 31)


def test_the_generator_is_the_one_it_names():
    golden = 0x9E3779B97F4A7C15
    first = [splitmix_finalizer((1234567 + k * golden) % 2**64) for k in (1, 2, 3)]
    assert first == [6457827717110365317, 3203168211198807973, 9817491932198370423]  # as other programs print them
    for seed, counter in ((0, 0), (1, 5), (-3, 12345), (2**63, -1), (2**64 - 1, 3)):
        key = splitmix_finalizer(seed % 2**64)
        key = splitmix_finalizer(key ^ splitmix_finalizer((counter + golden) % 2**64))
        expected = [(splitmix_finalizer((key + k * golden) % 2**64) >> 11) / 2**53 for k in (1, 2, 3)]
        assert counter_uniform(seed, torch.tensor([counter]), 3).tolist() == expected

"""How well a reading fits the track."""

import pytest
from support.tracks import f64

from magrl.tracking import FieldTrack, surprise


def test_the_surprise_does_not_depend_on_the_units_of_the_state() -> None:
    """A declination is continued, and a perfect sensor has the floor of 0.003 deg."""
    mean, covariance = f64((199.9, 0.1, 0.0), (60.0, 0.0, 0.0), (2e4, 0.0, 0.0)), f64(0.0).expand(3, 3, 3)
    found = [
        surprise(FieldTrack(mean / unit[:, None], covariance), f64(0.0, 0.0), f64(-160.0, 60.0, 2e4), (0.0,) * 3, unit)
        for unit in (f64(0.3, 1.5, 100.0), 1e-4 * f64(0.3, 1.5, 100.0))
    ]
    assert found == pytest.approx([(0.1 / 0.003) ** 2 / 3] * 2)

"""Facts of the paper that the library reproduces, each in one place.

Source: Bai et al., *Long-distance Geomagnetic Navigation in GNSS-denied Environments with Deep Reinforcement Learning*,
arXiv 2410.15837. The field generation, its date and the trip seeds are not printed there: docs/theory.md says how they
were determined or chosen.
"""

from __future__ import annotations

from typing import NamedTuple

LATITUDE, LONGITUDE = (-10.0, 0.0), (160.0, 170.0)
"""The box of the trips [deg]."""
DATE, GENERATION = "2022-01-01", 13
"""Date and IGRF generation that reproduce the printed field values at the two example points."""
DISTANCE_KM = (300.0, 500.0)
"""Shortest and longest distance from start to destination [km]."""
EXAMPLE_START, EXAMPLE_TARGET = (-2.0, 162.0), (-8.0, 164.0)
"""The trip of Fig. 5: latitude, longitude [deg]."""

TABLE_1 = {
    "num_cells": (512, 512, 512),
    "batch_size": 256,
    "buffer_size": 50_000,
    "gamma": 0.995,
    "tau": 0.005,
    "policy_delay": 2,
    "learning_rate": 1e-3,
    "exploration_noise": 0.2,
    "policy_noise": 0.1,
    "total_episodes": 20_000,
}
"""Hyperparameters of TD3, by the names of the recipe's configuration."""


class Result(NamedTuple):
    """A row of Table 2: means over 100 trips.

    Example:
        >>> TABLE_2["gg_td3"].success_rate
        97.0
    """

    success_rate: float
    trajectory_length_m: float
    spl: float
    steps: float


TABLE_2 = {
    "gg_td3": Result(97.0, 445564.313, 88.4119, 21.757),
    "td3": Result(89.0, 511983.904, 73.6277, 22.093),
    "ga": Result(51.0, 443360.591, 47.0986, 22.534),
    "pso": Result(29.0, 442495.161, 27.0941, 21.031),
    "afsa": Result(77.0, 515649.380, 63.6267, 35.560),
}
"""Published results by navigator: success rate [%], trajectory length [m], SPL [%], steps."""

"""Navigators: policies without training, each with its memory of the track."""

from __future__ import annotations

from magrl.navigators.base import Navigator
from magrl.navigators.geodesic import Geodesic
from magrl.navigators.kalman import Kalman
from magrl.navigators.map_matching import MapMatching
from magrl.navigators.mean_jacobian import MeanJacobian
from magrl.navigators.metaheuristics import ArtificialFishSwarm, GeneticAlgorithm, ParticleSwarm
from magrl.navigators.parallel import ParallelApproach
from magrl.navigators.quasi_newton import QuasiNewton
from magrl.navigators.run_and_tumble import RunAndTumble
from magrl.navigators.secant import Secant

_CLASSES: tuple[type[Navigator], ...] = (
    GeneticAlgorithm,
    ParticleSwarm,
    ArtificialFishSwarm,
    Secant,
    ParallelApproach,
    Kalman,
    MeanJacobian,
    Geodesic,
    RunAndTumble,
    MapMatching,
)
NAVIGATORS = {navigator.name: navigator for navigator in _CLASSES}
"""Classes by the names that commands take. Figures color them in this order: add a new one at the end."""

__all__ = [
    "NAVIGATORS",
    "Geodesic",
    "Kalman",
    "MapMatching",
    "MeanJacobian",
    "Navigator",
    "ParallelApproach",
    "QuasiNewton",
    "RunAndTumble",
    "Secant",
]

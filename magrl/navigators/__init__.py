"""Navigators: policies without training, each with its memory of the track."""

from __future__ import annotations

from magrl.navigators.base import Navigator as Navigator
from magrl.navigators.geodesic import Geodesic as Geodesic
from magrl.navigators.map_matching import MapMatching as MapMatching
from magrl.navigators.mean_jacobian import MeanJacobian as MeanJacobian
from magrl.navigators.metaheuristics import ArtificialFishSwarm, GeneticAlgorithm, ParticleSwarm
from magrl.navigators.parallel import ParallelApproach as ParallelApproach
from magrl.navigators.quasi_newton import QuasiNewton as QuasiNewton
from magrl.navigators.secant import Secant as Secant

_CLASSES: tuple[type[Navigator], ...] = (
    GeneticAlgorithm,
    ParticleSwarm,
    ArtificialFishSwarm,
    Secant,
    ParallelApproach,
    MeanJacobian,
    Geodesic,
    MapMatching,
)
NAVIGATORS = {navigator.name: navigator for navigator in _CLASSES}
"""Classes by the names that commands take. Figures color them in this order: add a new one at the end."""

"""Navigators: policies, trained or not; what they remember is in the TensorDict."""

from __future__ import annotations

from magrl.navigators.base import Navigator as Navigator
from magrl.navigators.base import policy_env as policy_env
from magrl.navigators.dead_reckoning import DeadReckoning as DeadReckoning
from magrl.navigators.kalman import Anywhere as Anywhere
from magrl.navigators.kalman import Kalman as Kalman
from magrl.navigators.memory import Memory as Memory
from magrl.navigators.metaheuristics import ArtificialFishSwarm, GeneticAlgorithm, ParticleSwarm
from magrl.navigators.networks import Geometry as Geometry
from magrl.navigators.networks import make_actor as make_actor
from magrl.navigators.networks import make_correcting_actor as make_correcting_actor
from magrl.navigators.networks import make_critic as make_critic
from magrl.navigators.oracles import Geodesic as Geodesic
from magrl.navigators.oracles import ParallelApproach as ParallelApproach
from magrl.navigators.quasi_newton import MeanJacobian as MeanJacobian
from magrl.navigators.quasi_newton import QuasiNewton as QuasiNewton
from magrl.navigators.quasi_newton import Secant as Secant
from magrl.navigators.trained import FieldPolicy as FieldPolicy
from magrl.navigators.trained import PolicyConfig as PolicyConfig
from magrl.navigators.trained import export_policy as export_policy
from magrl.navigators.trained import load_policy as load_policy
from magrl.navigators.trained import save_policy as save_policy

_CLASSES: tuple[type[Navigator], ...] = (
    Kalman,
    Anywhere,
    GeneticAlgorithm,
    ParticleSwarm,
    ArtificialFishSwarm,
    Secant,
    ParallelApproach,
    MeanJacobian,
    Geodesic,
    DeadReckoning,
    Memory,
)
NAVIGATORS = {navigator.name: navigator for navigator in _CLASSES}
"""Classes by the names that commands take. Figures color them in this order: add a new one at the end."""

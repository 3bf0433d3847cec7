"""Genetic algorithm, particle swarm and artificial fish swarm as navigators: the paper's baselines, in two modes.

The paper does not describe how a candidate move is evaluated. In mode ``"look-ahead"`` the navigator reads the field at
the end of each candidate before it chooses one: an oracle. In mode ``"flown"`` every individual is a move of the
episode, and its fitness is known after the move: no privileged key is read.

An individual is a displacement ``(north, east)`` in units of the longest move, limited to the disc of radius 1, so that
averages and differences of individuals are displacements too. Lower fitness is better.
"""

from magrl.navigators.metaheuristics.base import MODES as MODES
from magrl.navigators.metaheuristics.base import Metaheuristic as Metaheuristic
from magrl.navigators.metaheuristics.fish_swarm import ArtificialFishSwarm as ArtificialFishSwarm
from magrl.navigators.metaheuristics.genetic import GeneticAlgorithm as GeneticAlgorithm
from magrl.navigators.metaheuristics.particle_swarm import ParticleSwarm as ParticleSwarm

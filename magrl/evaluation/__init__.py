"""Evaluation: rollouts, measures and their intervals, tables, figures, and tracks for maps."""

from magrl.envs.measures import summarize as summarize
from magrl.evaluation.episodes import episode_measures as episode_measures
from magrl.evaluation.episodes import evaluation_rollout as evaluation_rollout
from magrl.evaluation.flight import Flight as Flight
from magrl.evaluation.flight import Sheet as Sheet
from magrl.evaluation.flight import evaluate as evaluate
from magrl.evaluation.scores import score as score

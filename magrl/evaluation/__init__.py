"""Evaluation: rollouts, measures and their intervals, tables, figures, and tracks for maps."""

from magrl.evaluation.flight import Flight as Flight
from magrl.evaluation.flight import evaluate as evaluate
from magrl.evaluation.metrics import episode_measures as episode_measures
from magrl.evaluation.metrics import summarize as summarize
from magrl.evaluation.rollout import evaluation_rollout as evaluation_rollout

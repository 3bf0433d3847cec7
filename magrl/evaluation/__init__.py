"""Evaluation: rollouts, measures and their intervals, tables, figures, replay pages, and tracks for maps."""

from magrl.evaluation.metrics import episode_measures, summarize
from magrl.evaluation.rollout import evaluate, evaluation_rollout

__all__ = ["episode_measures", "evaluate", "evaluation_rollout", "summarize"]

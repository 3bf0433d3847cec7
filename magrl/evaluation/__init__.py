"""Evaluation: rollouts, measures and their intervals, tables, figures, replay pages, and tracks for maps."""

from magrl.evaluation.metrics import episode_measures, summarize
from magrl.evaluation.rollout import evaluation_rollout

__all__ = ["episode_measures", "evaluation_rollout", "summarize"]

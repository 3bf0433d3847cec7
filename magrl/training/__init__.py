"""Infrastructure of a training: configuration, run folder, resume, signals, checkpoints, curves and loggers."""

from magrl.training.config import RunConfig, UsageError, command, parse_config
from magrl.training.run import Run

__all__ = ["Run", "RunConfig", "UsageError", "command", "parse_config"]

"""Infrastructure of a training: configuration, run folder, resume, signals, checkpoints, curves and wandb."""

from magrl.checks import UsageError as UsageError
from magrl.checks import command as command
from magrl.training.config import RegionConfig as RegionConfig
from magrl.training.config import RunConfig as RunConfig
from magrl.training.config import parse as parse
from magrl.training.config import parse_config as parse_config
from magrl.training.run import Run as Run

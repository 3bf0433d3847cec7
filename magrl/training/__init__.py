"""Training: losses of TD3, configuration, run folder, resume, signals, checkpoints, curves and wandb."""

from magrl.commands import UsageError as UsageError
from magrl.commands import command as command
from magrl.training.config import RegionConfig as RegionConfig
from magrl.training.config import RunConfig as RunConfig
from magrl.training.config import parse as parse
from magrl.training.config import parse_config as parse_config
from magrl.training.run import Run as Run
from magrl.training.td3 import SoftUpdate as SoftUpdate
from magrl.training.td3 import TD3Loss as TD3Loss
from magrl.training.td3 import mirrored as mirrored
from magrl.training.td3 import optimize as optimize
from magrl.training.td3 import saturation_penalty as saturation_penalty

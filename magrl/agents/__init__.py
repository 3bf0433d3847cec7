"""Agents: networks, the TD3 losses that train them, and trained policies with their files."""

from magrl.agents.td3 import SoftUpdate as SoftUpdate
from magrl.agents.td3 import TD3Loss as TD3Loss
from magrl.agents.td3 import optimize as optimize
from magrl.agents.td3 import saturation_penalty as saturation_penalty

"""Agents: networks, the TD3 losses that train them, and trained policies with their files."""

from magrl.agents.networks import AreaGeometry as AreaGeometry
from magrl.agents.networks import make_actor as make_actor
from magrl.agents.networks import make_correcting_actor as make_correcting_actor
from magrl.agents.networks import make_critic as make_critic
from magrl.agents.policy import FieldPolicy as FieldPolicy
from magrl.agents.policy import PolicyConfig as PolicyConfig
from magrl.agents.policy import export_policy as export_policy
from magrl.agents.policy import load_policy as load_policy
from magrl.agents.policy import save_policy as save_policy
from magrl.agents.td3 import SoftUpdate as SoftUpdate
from magrl.agents.td3 import TD3Loss as TD3Loss
from magrl.agents.td3 import optimize as optimize
from magrl.agents.td3 import saturation_penalty as saturation_penalty

"""Agents: networks, the TD3 losses that train them, and trained policies with their files."""

from magrl.agents.exported import ExportedPolicy, export_policy
from magrl.agents.networks import make_actor, make_critic
from magrl.agents.policy import FieldPolicy, PolicyConfig, load_policy, save_policy
from magrl.agents.pretrained import load_pretrained
from magrl.agents.recurrent import RecurrentTD3Loss, make_recurrent_actor, recurrent_transforms
from magrl.agents.td3 import SoftUpdate, TD3Loss, optimize, saturation_penalty

__all__ = [
    "ExportedPolicy",
    "FieldPolicy",
    "PolicyConfig",
    "RecurrentTD3Loss",
    "SoftUpdate",
    "TD3Loss",
    "export_policy",
    "load_policy",
    "load_pretrained",
    "make_actor",
    "make_critic",
    "make_recurrent_actor",
    "optimize",
    "recurrent_transforms",
    "saturation_penalty",
    "save_policy",
]

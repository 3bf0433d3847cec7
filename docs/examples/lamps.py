"""Guidance in an environment of your own: robots find a place on a floor by the light of two lamps.

python docs/examples/lamps.py    # seconds
"""

from magrl import AlignmentReward, FieldGradient, GradientHeading

import torch
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.envs.utils import make_composite_from_td


def light(position):
    """Return the brightness of each lamp at a place, in logarithms."""
    return -(position - torch.tensor([[-1.0, 0.0], [0.0, -1.0]])).square().sum(-1).log()


class Robots(EnvBase):
    """Turn by the action [rad], then drive 0.1 m; arrive within 0.1 m of the target."""

    def __init__(self):
        super().__init__(batch_size=[100])
        self.observation_spec = make_composite_from_td(self._reset())
        self.action_spec = self.reward_spec = Unbounded((100, 1))

    def _set_seed(self, seed):
        torch.manual_seed(seed)

    def _reset(self, _=None):
        return self.seen(3 * torch.rand(100, 2), 3 * torch.rand(100, 2), torch.zeros(100, 1))

    def _step(self, td):
        heading, target = td["heading"] + td["action"], td["target_position"]
        position = td["position"] + 0.1 * torch.cat((heading.cos(), heading.sin()), -1)
        near = (position - target).norm(dim=-1, keepdim=True) < 0.1
        return self.seen(position, target, heading).update({"reward": 1.0 * near, "done": near})

    def seen(self, position, target, heading):
        """Return what the transforms read, by their default keys."""
        values = {"field": torch.vmap(light)(position), "target_field": torch.vmap(light)(target)}
        return TensorDict(values | {"position": position, "target_position": target, "heading": heading}, [100])


def straight_on(td):
    """Keep the first heading."""
    return td.set("action", torch.zeros(100, 1))


def guided(td):
    """Turn to the theoretical heading."""
    return td.set("action", td["gradient_heading"] - td["heading"])


torch.manual_seed(0)
env = TransformedEnv(Robots(), Compose(FieldGradient(light), GradientHeading(pair=(0, 1)), AlignmentReward()))
for policy in (straight_on, guided):
    steps = env.rollout(50, policy, break_when_any_done=False, break_when_all_done=True)["next"]
    print(f"{policy.__name__}: {steps['done'].any(1).float().mean():.0%} arrive, reward {steps['reward'].mean():.1f}")

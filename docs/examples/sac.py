"""Soft actor-critic (SAC) on the paper's task, from TorchRL's parts: training, export to ONNX, evaluation.

python docs/examples/sac.py    # one to two minutes on one core
"""

from magrl import AlignmentReward, FieldGradient, GeomagneticNavEnv, GradientHeading, evaluate, save_policy, summarize
from magrl.navigators import make_critic

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, RewardScaling, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

total_frames = 60_000  # steps of all vehicles together
num_envs = 512
batch_size = 1024
updates = 8
torch.manual_seed(0)

# Environment: rewards, an observation scaled to the region, actions in [-1, 1]
base = GeomagneticNavEnv(num_envs=num_envs, seed=0)
view = base.observation_view()
env = TransformedEnv(
    base,
    Compose(
        FieldGradient(base.field),  # privileged: for the reward only
        GradientHeading(),
        AlignmentReward(weight=3.0),
        RewardScaling(loc=0.0, scale=0.05),
        *view.observation_transforms(),
        view.action_transform(),
    ),
)

# Networks
size = view.size
layers = {"num_cells": [128, 128, 128], "norm_class": nn.LayerNorm, "norm_kwargs": [{"normalized_shape": 128}] * 3}
network = nn.Sequential(MLP(size, 4, activation_class=nn.ReLU, **layers), NormalParamExtractor("biased_softplus_0.3"))
actor = ProbabilisticActor(
    TensorDictModule(network, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    spec=env.action_spec_unbatched,
    distribution_class=TanhNormal,
)
loss = SACLoss(actor, make_critic(size, (128, 128, 128)), alpha_init=0.1, target_entropy=-4.0)
loss.make_value_estimator(gamma=0.9)
target_update = SoftUpdate(loss, tau=0.01)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)

# Training
frames = {"frames_per_batch": num_envs, "total_frames": total_frames, "init_random_frames": 2 * num_envs}
collector = Collector(env, actor, auto_register_policy_transforms=False, **frames)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(200_000), batch_size=batch_size)
for batch in collector:
    buffer.extend(batch.reshape(-1).select("observation", "action", "next"))
    for _ in range(updates if len(buffer) >= batch_size else 0):
        losses = loss(buffer.sample())
        optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        optimizer.step()
        target_update.step()
collector.shutdown()

# Result
save_policy("sac.onnx", actor, view)
episodes = evaluate("sac.onnx", "test-1000")
summary = summarize(episodes)
print(f"SR {summary['success_rate']:.1f} %, SPL {summary['spl']:.1f} %")

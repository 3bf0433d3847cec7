"""Train DDPG without a map, on random planets and from the plan of `kalman`, and compare it on Earth.

python docs/examples/ddpg_anywhere.py    # two minutes on one core
"""

from magrl import Anywhere, GeomagneticNavEnv, earth_scenario, evaluate, planet_scenario, save_policy, summarize
from magrl.agents import make_correcting_actor, make_critic
from magrl.evaluation.tables import short_table
from magrl.sensor_std import STD_KEYS
from magrl.tracking import OBSERVATION_SIZE, Rules, correction_network
from magrl.transforms import (
    HighestSPL,
    MinMaxNorm,
    RandomStepPrice,
    SensorErrors,
    SPLReward,
    TrackField,
    TrueWay,
    sensor_levels,
)

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import DDPGLoss, SoftUpdate

total_frames, num_regions, num_tasks = 100_000, 1024, 1000
num_envs, batch_size, updates = 512, 1024, 8
torch.manual_seed(0)

# Environment: planets, errors of the sensors, what the vehicle observes, and the reward, which is privileged
regions = {"distance_range_km": (300, 500), "start_heading": "random"}
base = GeomagneticNavEnv(planet_scenario(num_regions, seed=0, **regions), num_envs=num_envs, seed=0)
rules = Rules(**base.limits)
reward = [RandomStepPrice((0.1, 0.1)), TrueWay(), HighestSPL(), SPLReward()]
observed = [SensorErrors(levels=sensor_levels), TrackField(rules, STD_KEYS), MinMaxNorm(in_keys_inv=["action"])]
env = TransformedEnv(base, Compose(*observed, *reward))

# Networks and loss
network = correction_network((128, 128, 128))  # corrects the plan of the track, at first by nothing
actor = make_correcting_actor(network, rules)
critic = make_critic(OBSERVATION_SIZE, (128, 128, 128))
loss = DDPGLoss(actor, critic, delay_actor=True)
loss.make_value_estimator(gamma=0.95)
target_update = SoftUpdate(loss, tau=0.01)
rates = [{"params": actor.parameters(), "lr": 1e-4}, {"params": critic.parameters(), "lr": 1e-3}]
optimizer = torch.optim.Adam(rates)
schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, total_frames // num_envs)

# Training
exploration = TensorDictSequential(actor, AdditiveGaussianModule(env.action_spec_unbatched, 0.1, 0.1))
frames = {"frames_per_batch": num_envs, "total_frames": total_frames}
collector = Collector(env, exploration, auto_register_policy_transforms=False, **frames)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(total_frames), batch_size=batch_size)
observed = [("observation",), ("track", "plan"), ("heading",)]  # not the belief, which is large
ends = [("next", *key) for key in (*observed, ("reward",), ("done",), ("terminated",))]
for batch in collector:
    buffer.extend(batch.reshape(-1).select(*observed, "action", *ends))
    for _ in range(updates if len(buffer) >= batch_size else 0):
        sample = buffer.sample()
        losses = loss(sample)
        penalty = network(sample["observation"]).square().mean()  # stay near the plan while the critic is poor
        optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_value"] + 0.1 * penalty).backward()
        optimizer.step()
        target_update.step()
    schedule.step()
collector.shutdown()

# Rows of a table, on Earth
save_policy("ddpg.safetensors", Anywhere(rules, network))
earth = earth_scenario(128, seed=1, **regions)
tasks = earth.with_tasks(earth.random_tasks(num_tasks, seed=2))
for noise in ((0.0, 0.0, 0.0), (0.05, 0.05, 5.0)):
    names = ("policy:DDPG=ddpg.safetensors", "anywhere", "kalman")
    episodes = {name: evaluate(name, tasks, errors=noise) for name in names}
    print(noise, short_table({name: [summarize(rows)] for name, rows in episodes.items()}), sep="\n")

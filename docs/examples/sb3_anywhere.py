"""stable-baselines3 without a map: train PPO on random planets, and compare it on Earth.

    pip install -c constraints.txt -e '.[sb3]'
    python docs/examples/sb3_anywhere.py    # minutes on one core

The action of this agent is the leg itself; `anywhere` corrects the leg that `kalman` plans.
"""

from magrl import earth_scenario, evaluate, summarize
from magrl.envs.sb3 import BatchedVecEnv
from magrl.errors import SensorErrors
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.evaluation.tables import short_table
from magrl.named_tasks import anywhere_env

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor
from tensordict.nn import TensorDictModule
from torch import Tensor

total_timesteps = 400_000
num_trips = 500

# Training on random planets, with random noise of the sensors
envs = gymnasium.make_vec("magrl/GeomagneticNavigationAnywhere-v2", num_envs=512, autoreset_mode="SameStep")
options = {"n_steps": 32, "batch_size": 2048, "n_epochs": 5, "learning_rate": 1e-3, "device": "cpu", "seed": 0}
vehicles = VecMonitor(BatchedVecEnv(envs))
model = PPO("MlpPolicy", vehicles, **options, policy_kwargs={"net_arch": [128, 128], "log_std_init": -1.0})
model.learn(total_timesteps)


def act(observation: Tensor) -> Tensor:
    """Return the deterministic action."""
    return model.policy(observation, deterministic=True)[0].clamp(-1, 1)


# Evaluation on Earth
earth = earth_scenario(64, seed=1, distance_range_km=(300, 500), start_heading="random")
earth = earth.with_trips(earth.random_trips(num_trips, seed=2))
noise = (0.05, 0.05, 5.0)
env = anywhere_env(num_trips, scenario=earth, transforms=[SensorErrors(noise)])
rollout = evaluation_rollout(env, TensorDictModule(act, ["observation"], ["action"]))
rows = {"PPO of stable-baselines3": [summarize(episode_measures(rollout))]}
rows |= {name: [summarize(evaluate(name, earth, errors=noise))] for name in ("anywhere", "kalman")}
print(short_table(rows))

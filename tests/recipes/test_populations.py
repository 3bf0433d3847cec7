"""Metaheuristics that keep one population over a trip."""

import torch
from support.recipes import load

from magrl.envs import GeomagneticNavEnv
from magrl.navigators import policy_env
from magrl.navigators.metaheuristics import in_disc

populations = load("docs/tables/populations")


def test_a_kept_swarm_moves_once_a_step_and_its_best_particle_is_flown() -> None:
    env = GeomagneticNavEnv(num_envs=2, seed=0)
    swarm = populations.KeptPSO(env.field)
    after = policy_env(env, swarm).rollout(3, swarm)["next"]
    place, velocity, lowest = (after["memory", key] for key in ("population", "velocity", "lowest"))
    torch.testing.assert_close(place[:, 1:], in_disc(place[:, :-1] + velocity[:, 1:]))
    assert velocity.abs().sum((2, 3)).min() > 0
    torch.testing.assert_close(after["objective"][:, 0, 0].double(), lowest[:, 0].amin(-1), rtol=1e-4, atol=1e-6)


def test_the_table_has_the_papers_rows() -> None:
    rows = populations.table("paper-example").splitlines()[2:]
    assert [row.split(" | ")[0] for row in rows[:2]] == ["| GA, paper", f"| {populations.KeptGA.description}"]
    assert len(rows) == 6

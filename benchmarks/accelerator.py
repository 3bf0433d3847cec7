"""Cost of a step by number of vehicles, of its parts and of training: `python -m benchmarks.accelerator --device cuda`.

Prints a Markdown table of microseconds per vehicle and the name of the device, under four minutes on a GPU. A part that
does not fit into memory is left out. The training is one gradient of the critic and the actor of Gradient-Guided TD3.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable, Sequence

from benchmarks.update import CONFIG
from magrl import tracking
from magrl.agents import SoftUpdate, TD3Loss, make_actor, make_critic
from magrl.envs import GeomagneticNavEnv
from magrl.evaluation.navigators import make_navigator
from magrl.sensor_std import SensorStd

import torch
from tensordict import TensorDict

VEHICLES = (512, 8192, 131_072, 1_048_576)
SECONDS = 2.0


def microseconds(part: Callable[[], object], vehicles: int, device: torch.device) -> float | None:
    """Return the time of a part for each vehicle [µs], the best of what fits into :data:`SECONDS`; None for a part
    that does not fit into memory."""
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    times: list[float] = []
    try:
        with torch.no_grad():
            part()
            while not times or sum(times) < SECONDS:
                wait()
                begun = time.perf_counter()
                part()
                wait()
                times.append(time.perf_counter() - begun)
    except (torch.OutOfMemoryError, RuntimeError) as error:
        if "memory" not in str(error).lower():
            raise
        return None
    return 1e6 * min(times) / vehicles


def parts(vehicles: int, device: torch.device) -> dict[str, Callable[[], object]]:
    """Return the parts of a step by name."""
    env = GeomagneticNavEnv(num_envs=vehicles, seed=0, device=device)
    state = env.rand_action(env.reset())
    policy = make_navigator("kalman", env)
    std = torch.tensor([0.05, 0.05, 5.0], device=device).expand(vehicles, 3)
    errors, course = SensorStd(std, *[torch.zeros_like(std)] * 3), state["heading"].squeeze(-1)
    belief = tracking.start(state["field"], errors, course)
    distance = torch.full_like(course, 50.0)
    goal = tracking.destination(belief, state["target_field"], tracking.RANGE_KM)
    actor, critic = (make(13, CONFIG.num_cells, device=device) for make in (make_actor, make_critic))
    loss = TD3Loss(actor, critic, gamma=0.9, policy_noise=0.1, noise_clip=0.5)
    SoftUpdate(loss, tau=0.01)
    transitions = TensorDict(observation=torch.zeros(vehicles, 13, device=device), action=state["action"])
    transitions["next"] = TensorDict(observation=transitions["observation"], reward=course[:, None])
    for name in ("done", "terminated"):
        transitions["next", name] = torch.zeros_like(course[:, None], dtype=torch.bool)
    transitions.batch_size = [vehicles]

    def update() -> None:
        with torch.enable_grad():
            (loss.value_loss(transitions)[0] + loss.actor_loss(transitions)[0]).backward()

    return {
        "environment": lambda: env.step(state),
        "belief: move and reading": lambda: tracking.read(
            tracking.moved(belief, distance, course, errors), state["field"], std, course
        ),
        "posterior of the destination": lambda: tracking.posterior(goal),
        "decision: belief, posterior and plan": lambda: policy(state),
        "training: gradients of a transition": update,
    }


def table(vehicles: Sequence[int], device: torch.device) -> str:
    """Return the Markdown table of all parts."""
    lines = ["| µs per vehicle | " + " | ".join(map(str, vehicles)) + " |", "|---|" + "---|" * len(vehicles)]
    rows: dict[str, list[str]] = {}
    for number in vehicles:
        for name, part in parts(number, device).items():
            cost = microseconds(part, number, device)
            rows.setdefault(name, []).append("–" if cost is None else f"{cost:.3g}")
    return "\n".join([*lines, *(f"| {name} | " + " | ".join(values) + " |" for name, values in rows.items())]) + "\n"


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--vehicles", type=int, nargs="+", default=VEHICLES)
    chosen = parser.parse_args(args)
    device = torch.device(chosen.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.machine()
    print(table(chosen.vehicles, device) + f"\n{name}, torch {torch.__version__}")


if __name__ == "__main__":
    main()

"""Networks of actors and critics."""

import math

import pytest
import torch
from tensordict import TensorDict

from magrl.envs.navigation import navigation_env
from magrl.named_tasks import no_go_env
from magrl.navigators import make_actor
from magrl.navigators.networks import CorrectedLeg, Geometry
from magrl.pilot import Rules
from magrl.transforms import NoGoAreas
from magrl.transforms.areas import distance_km


def test_new_actor_is_not_saturated() -> None:
    """Half the longest leg and no turn, give or take what the weights add."""
    torch.manual_seed(0)
    actions = make_actor(13, (16, 16))(TensorDict(observation=2 * torch.rand(50, 13) - 1, batch_size=[50]))["action"]
    assert actions.abs().max() < 0.95
    assert actions.std(0).min() > 0.01


def test_a_correction_scales_and_turns_the_plan() -> None:
    """Up to the longest leg; where the turn is too large, the vehicle turns where it is."""
    corrected = CorrectedLeg(Rules())
    planned = torch.tensor([[20.0, 0.0], [20.0, 0.0], [0.0, 40.0], [-10.0, 0.0]])
    change = torch.tensor([[0.0, 1.0], [2 * math.log(2.0), 0.0], [2.0, -math.pi], [0.0, -0.1]])
    expected = torch.tensor([[-0.2, 1 / math.pi], [0.6, 0.0], [1.0, 0.0], [-1.0, 1.0]])
    torch.testing.assert_close(corrected(planned, torch.zeros(4, 1), change), expected)
    turned = corrected(planned[:1], torch.tensor([[0.3]]), torch.zeros(1, 2))  # at a heading, without a correction
    torch.testing.assert_close(turned, torch.tensor([[-0.2, -0.6 / math.pi]]))


def test_bad_sizes_are_refused() -> None:
    for size, cells in ((0, (8,)), (13, (0,)), (13, (1.5,)), (13, (10**9,))):
        with pytest.raises(ValueError, match="must be a whole number from 1 up to 65536"):
            make_actor(size, cells)


def test_the_geometry_of_the_destination_turns_with_the_heading() -> None:
    """Differences and headings that turn together give the same features, whatever the size of the differences."""
    view = navigation_env(seed=0).view
    angle = torch.tensor([0.3, 2.0])
    seen = torch.zeros(2, 13)
    seen[:, view.columns["difference"]] = torch.tensor([[0.2, -0.1, 0.3], [0.02, -0.01, 0.03]])
    seen[:, view.columns["heading"]] = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    turned, direction, size = Geometry(view)(seen)[:, 13:].split((6, 6, 1), -1)
    expected = torch.tensor([0.2, -0.1, 0.3]).outer(torch.tensor([math.cos(0.3), math.sin(0.3)])).flatten()
    torch.testing.assert_close(turned[0], expected)
    norms = seen[:, view.columns["difference"]].norm(dim=-1, keepdim=True) + 0.01
    torch.testing.assert_close(direction, turned / norms)
    torch.testing.assert_close(size, norms.log())


@pytest.mark.parametrize("without", [(), ("observe_difference",), ("observe_difference", "observe_heading")], ids=str)
@pytest.mark.parametrize("max_leg_km", [50.0, 30.0])
def test_the_geometry_of_areas_is_that_of_their_discs(max_leg_km: float, without: tuple[str, ...]) -> None:
    """Bearings of center and edges, and by how much a leg clears each disc, from the observation alone."""
    generator = torch.Generator().manual_seed(0)
    centers = 60 + 100 * torch.rand(50, 4, 2, generator=generator)
    radii = 15 + 25 * torch.rand(50, 4, generator=generator)
    seen = NoGoAreas()._seen(centers, radii, torch.zeros(50, 1))
    action = 2 * torch.rand(50, 2, generator=generator) - 1
    env = no_go_env(seed=0, max_leg_km=max_leg_km, max_turn_deg=60.0, **dict.fromkeys(without, False))
    before = torch.zeros(50, env.view.size - 12)
    features = Geometry(env.view.geometry)(torch.cat((before, seen, action), -1))
    about, clear_by, _, kept = features[:, -34:].split((24, 4, 4, 2), -1)
    torch.testing.assert_close(kept, action)
    order = (centers.norm(dim=-1) - radii).argsort(-1)
    center, radius = centers.take_along_dim(order.unsqueeze(-1), -2), radii.gather(-1, order)
    there = seen.unflatten(-1, (4, 3))[..., 2] > 0
    bearing, half = torch.atan2(center[..., 1], center[..., 0]), torch.asin(radius / center.norm(dim=-1))
    expected = torch.stack((half, bearing - half, bearing + half), -1) / (math.pi / 2)
    about = about.unflatten(-1, (4, 6))
    torch.testing.assert_close(about[there][:, 3:], expected[there], atol=1e-4, rtol=0)
    assert (about[~there] == 0).all()
    turn, length = action[:, 1:] * math.pi / 3, max_leg_km / 2 * (action[:, :1] + 1)
    end = length * torch.cat((torch.cos(turn), torch.sin(turn)), -1)
    clear = (distance_km(center, torch.zeros(50, 2), end) - radius) / 20
    torch.testing.assert_close(clear_by[there], clear.clamp(-1.5, 3)[there], atol=1e-3, rtol=0)
    assert (clear_by[~there] == 3).all()
    assert 0 < there.sum() < 200

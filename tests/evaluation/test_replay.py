"""The page that replays episodes: its numbers, its safety, its behavior in a real browser, and the recipe."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from playwright.sync_api import Page, expect, sync_playwright
from support.recipes import load
from tensordict.nn import TensorDictModule

from magrl.agents import FieldPolicy, save_policy
from magrl.agents.policy import PolicyConfig
from magrl.envs import GeomagneticNavEnv, Region, Scenario, Tasks, named_tasks
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.evaluation.replay import PIECES, episode_tracks, replay_data, write_replay
from magrl.field import elements_at
from magrl.field.elements import NAMES
from magrl.geodesy import geodesic
from magrl.navigators import NAVIGATORS
from magrl.training import UsageError

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
HOSTILE = "</script><img src=x onerror=alert(1)><!-- ${1}"


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    tasks = Tasks(*(end[:3] for end in named_tasks("test-1000")))
    return GeomagneticNavEnv(Scenario(tasks=tasks), num_envs=3, seed=0)


@pytest.fixture(scope="module")
def rollouts(env: GeomagneticNavEnv) -> dict[str, Any]:
    return {name: evaluation_rollout(env, NAVIGATORS[name].for_env(env)) for name in ("secant", "parallel")}


@pytest.fixture(scope="module")
def data(env: GeomagneticNavEnv, rollouts: dict[str, Any]) -> dict[str, Any]:
    named = {"secant": rollouts["secant"], HOSTILE: rollouts["parallel"]}
    return replay_data(named, env.field, env.region, zeta=env.zeta, title=HOSTILE)


@pytest.fixture(scope="module")
def path(data: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "replay.html"
    write_replay(path, data)
    return path


def written(path: Path) -> dict[str, Any]:
    """Return the data that a browser reads from the page."""
    return json.loads(re.search(r'id="replay-data">(.*?)</script>', path.read_text(), re.DOTALL)[1])


def test_the_page_holds_the_rollouts(path: Path, rollouts: dict[str, Any]) -> None:
    for navigator, rollout in zip(written(path)["navigators"], rollouts.values(), strict=True):
        for row, episode in zip(rollout, navigator["episodes"], strict=True):
            count = episode["steps"]
            states = {
                key: torch.cat((row[key][:1], row["next", key][:count])).double().numpy()
                for key in ("position", "field", "objective", "move", "heading")
            }
            np.testing.assert_allclose(episode["track"][::PIECES], states["position"], atol=6e-6)
            np.testing.assert_allclose(episode["field"], states["field"], atol=6e-5)
            np.testing.assert_allclose(episode["objective"], states["objective"][:, 0], rtol=6e-4)
            np.testing.assert_allclose(episode["move_km"], states["move"][:, 0], atol=6e-4)
            np.testing.assert_allclose(np.radians(episode["turn_deg"]), states["move"][:, 1], atol=1e-4)
            heading = np.radians(episode["heading_deg"])
            np.testing.assert_allclose(np.sin(heading), np.sin(states["heading"])[:, 0], atol=2e-4)
            assert row["next", "done"][:count].flatten().tolist() == [False] * (count - 1) + [True]


def test_measures_and_tasks_are_those_of_the_rollouts(data: dict[str, Any], rollouts: dict[str, Any], env) -> None:
    for navigator, rollout in zip(data["navigators"], rollouts.values(), strict=True):
        measures = episode_measures(rollout)
        for key in ("steps", "shortest_km", "length_km", "navigation_error_km", "spl"):
            np.testing.assert_allclose([x[key] for x in navigator["episodes"]], measures[key], atol=6e-5)
        for episode in navigator["episodes"]:
            assert episode["outcome"] == "arrived"
            ends = episode["distance_km"][0], episode["distance_km"][-1], episode["path_km"][-1]
            keys = ("shortest_km", "navigation_error_km", "length_km")
            assert ends == pytest.approx([episode[key] for key in keys], abs=2e-3)
    target = env.tasks.target
    for key, expected in (("start", env.tasks.start), ("target", target), ("field", elements_at(env.field, target))):
        np.testing.assert_allclose(
            [task[key] for task in data["tasks"]], expected, atol=2e-3 if key == "field" else 6e-6
        )


def test_pieces_of_a_leg_are_equal_and_on_its_geodesic(env: GeomagneticNavEnv, rollouts: dict[str, Any]) -> None:
    for track in episode_tracks(rollouts["secant"], env.region):
        pieces, _ = geodesic(*track[:-1].T, *track[1:].T)
        legs, _ = geodesic(*track[:-PIECES:PIECES].T, *track[PIECES::PIECES].T)
        np.testing.assert_allclose(pieces.reshape(-1, PIECES), legs[:, None].expand(-1, PIECES) / PIECES, atol=1e-2)


def test_no_track_breaks_at_the_antimeridian() -> None:
    region = Region((-10, 0), (175, 185))
    tasks = Tasks(*(torch.tensor([end], dtype=torch.float64) for end in ((-5.0, 179.0), (-5.0, -178.0))))
    env = GeomagneticNavEnv(Scenario(region=region, tasks=tasks), num_envs=1, seed=0)
    rollout = evaluation_rollout(env, NAVIGATORS["parallel"].for_env(env))
    data = replay_data({"parallel": rollout}, env.field, region, zeta=env.zeta)
    longitude = np.array(data["navigators"][0]["episodes"][0]["track"])[:, 1]
    assert longitude[0] == pytest.approx(179)
    assert longitude[-1] == pytest.approx(182, abs=0.2)
    assert np.abs(np.diff(longitude)).max() < 0.5
    assert data["tasks"][0]["target"] == [-5.0, 182.0]
    assert data["tasks"][0]["name"] == "1"
    (named,) = replay_data({"parallel": rollout}, env.field, region, zeta=env.zeta, names=["home"])["tasks"]
    assert named["name"] == "home"
    with pytest.raises(ValueError, match=r"one name for each of 1 tasks, got \['a', 'b'\]"):
        replay_data({"parallel": rollout}, env.field, region, zeta=env.zeta, names="ab")
    assert data["region"]["longitude"] == (175, 185)


def test_contours_are_where_the_field_has_their_level(data: dict[str, Any]) -> None:
    field = Scenario().build_field()
    tolerance = {"D": 2e-3, "I": 2e-3, "B_H": 0.5}
    for index, name in enumerate(NAMES):
        assert len({line["level"] for line in data["contours"][name]}) > 4
        for line in data["contours"][name]:
            place = torch.tensor(line["line"], dtype=torch.float64).flip(-1)
            values = elements_at(field, place)[:, index]
            np.testing.assert_allclose(values, line["level"], atol=tolerance[name])


def test_a_failed_episode_says_how(env: GeomagneticNavEnv) -> None:
    rollouts = {}
    for name, distance in (("north", 50.0), ("nowhere", 0.0)):
        action = torch.tensor([distance, 0.0]).expand(3, 2)
        policy = TensorDictModule(lambda _, action=action: action, ["heading"], ["action"])
        rollouts[name] = evaluation_rollout(env, policy)
    north, nowhere = replay_data(rollouts, env.field, env.region, zeta=env.zeta)["navigators"]
    assert {episode["outcome"] for episode in north["episodes"]} == {"lost"}
    assert {episode["outcome"] for episode in nowhere["episodes"]} == {"out of steps"}
    assert {episode["spl"] for episode in nowhere["episodes"]} == {0}


def test_rollouts_of_different_tasks_are_refused(env: GeomagneticNavEnv, rollouts: dict[str, Any]) -> None:
    other = {"secant": rollouts["secant"], "random": GeomagneticNavEnv(num_envs=3, seed=5).rollout(2)}
    with pytest.raises(ValueError, match="'random' is of other tasks than 'secant'"):
        replay_data(other, env.field, env.region, zeta=0.01)


def test_the_page_asks_for_nothing_and_names_cannot_break_out(path: Path) -> None:
    text = path.read_text()
    markup = re.sub(r'(id="replay-data">).*?(</script>)', r"\1\2", text, flags=re.DOTALL)
    assert not re.findall(
        r"""(?:src|href)\s*=(?!\s*"data:)|@import|url\(|fetch\(|XMLHttp|https?:(?!//www\.w3\.org)""", markup
    )
    assert "default-src 'none'" in text
    assert len(text) < 200_000
    assert (text.count("</script>"), "<img" in text) == (2, False)
    assert written(path)["title"] == written(path)["navigators"][1]["label"] == HOSTILE


def test_damaged_data_is_refused(data: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        write_replay(tmp_path / "a.html", data | {"zeta": float("nan")})
    with pytest.raises(KeyError, match="it lacks navigators, tasks"):
        write_replay(tmp_path / "a.html", {"title": "", "contours": {}})
    assert not (tmp_path / "a.html").exists()


# The recipe


def test_the_recipe_flies_the_run_first(env: GeomagneticNavEnv, tmp_path: Path) -> None:
    """With the settings of the training; a run without guidance is TD3."""
    recipe, run = load("replay"), tmp_path / "agent"
    run.mkdir()
    torch.manual_seed(0)
    save_policy(run / "policy.safetensors", FieldPolicy(PolicyConfig(env.observation_view(), (8,), layer_norm=False)))
    box = {"latitude": [-10.0, 0.0], "longitude": [160.0, 170.0]}
    scenario = {"region": box, "date": "2022-01-01", "generation": 13, "max_steps": 12}
    tasks = [{"start": [-2.0, 162.0], "target": [-8.0, 164.0]}, {"start": [-3.0, 163.0], "target": [-6.0, 165.0]}]
    (run / "scenario.json").write_text(json.dumps(scenario | {"tasks": tasks}))
    settings = {"guided": False, "zeta": 0.5, "scenario": "elsewhere/scenario.json"}
    (run / "config.json").write_text(json.dumps(settings))
    out = recipe.replay(recipe.Config(run, (f"td3={run}", "geodesic"), gif=tmp_path / "a.gif"))
    assert out == run / "replay.html"
    data = written(out)
    labels = [navigator["label"] for navigator in data["navigators"]]
    assert labels == ["TD3", "TD3 (agent)", "geodesic (both positions, an oracle)"]
    assert [task["start"] for task in data["tasks"]] == [task["start"] for task in tasks]
    assert (data["zeta"], data["title"]) == (0.5, "agent, tasks of scenario.json")
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames > 1
    options = {"run": run, "navigators": (), "out": tmp_path / "none.html"}
    for change, message in (
        ({"navigators": ("dowsing",)}, "unknown navigator 'dowsing'"),
        ({"num_tasks": 3}, "from 1 up to 2, got 3"),
        ({"run": Path("nowhere")}, "no run at nowhere"),
    ):
        with pytest.raises(UsageError, match=message):
            recipe.replay(recipe.Config(**(options | change)))
        assert not options["out"].exists()


# The page in a browser


@pytest.fixture
def page(path: Path) -> Iterator[Page]:
    """Open the page from disk in a headless Chromium; at the end, no error was logged and nothing was requested.

    With MAGRL_REQUIRE_BROWSER set, as .ci/run does, a missing Chromium is a failure.
    """
    if CHROMIUM is None:
        say = pytest.fail if os.environ.get("MAGRL_REQUIRE_BROWSER") else pytest.skip
        say("there is no Chromium on the PATH: apt-get install chromium")
    expect.set_options(timeout=20_000)
    logged, requested = [], []
    with sync_playwright() as playwright:
        # A container's root may not use Chromium's sandbox; the page is our own and requests nothing.
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.on("console", lambda message: logged.append(message.text))
        page.on("pageerror", lambda error: logged.append(str(error)))
        page.on("dialog", lambda dialog: (logged.append(dialog.message), dialog.dismiss()))
        page.on("request", lambda request: requested.append(request.url))
        page.goto(path.as_uri())
        yield page
        browser.close()
    assert logged == []
    assert [url for url in requested if not url.startswith("data:")] == [path.as_uri()]


def texts(page: Page) -> dict[str, str]:
    """What every element that has an id reads, with ASCII signs."""
    found = page.evaluate("Object.fromEntries([...document.querySelectorAll('[id]')].map((e) => [e.id, e.innerText]))")
    return {name: (text or "").replace("−", "-") for name, text in found.items()}


def assert_shows(page: Page, episode: dict[str, Any], step: int) -> None:
    """The read-outs are those of an episode at a step."""
    shown, near = texts(page), partial(pytest.approx, abs=0.051)
    said = re.match(r"Step (\d+) of (\d+), ([\d.]+) km to the destination", shown["status"])
    assert [float(number) for number in said.groups()] == near([step, episode["steps"], episode["distance_km"][step]])
    expected = {f"now-{name}": episode[f"{name}_km"][step] for name in ("distance", "path", "move")}
    expected |= {"now-heading": episode["heading_deg"][step], "steps": episode["steps"], "spl": 100 * episode["spl"]}
    expected |= {"length": episode["length_km"], "shortest": episode["shortest_km"]}
    expected |= {"error": episode["navigation_error_km"]}
    assert {name: float(shown[name].strip("°")) for name in expected} == near(expected)
    assert float(shown["now-objective"]) == pytest.approx(episode["objective"][step], rel=0.06)
    for name, value in zip(NAMES, episode["field"][step], strict=True):
        assert float(shown[f"here-{name}"].split()[0]) == pytest.approx(value, abs=0.51 if name == "B_H" else 6e-4)
    assert (shown["outcome"], shown["now-step"]) == (episode["outcome"], f"{step} of {episode['steps']}")


def test_the_page_replays_the_episodes(page: Page, data: dict[str, Any]) -> None:
    """By its buttons, keys, slider, choices and links; names are shown as text."""
    episode = data["navigators"][0]["episodes"][0]
    assert_shows(page, episode, 0)
    vehicle = page.locator("#map .vehicle")
    start = vehicle.get_attribute("transform")
    page.get_by_label("Speed").last.select_option("5")
    page.get_by_role("button", name="Play").click()
    expect(page.locator("#play")).to_have_text("Pause")
    expect(page.locator("#now-step")).to_have_text(f"{episode['steps']} of {episode['steps']}")
    expect(page.locator("#play")).to_have_text("Play")  # it stops by itself
    assert_shows(page, episode, episode["steps"])
    assert vehicle.get_attribute("transform") != start
    assert "arrived" in vehicle.get_attribute("class")
    for key, step in (("Home", 0), ("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", episode["steps"])):
        page.keyboard.press(key)
        assert_shows(page, episode, step)
    page.get_by_label("Step", exact=True).fill("3")
    page.get_by_role("button", name="One step back").click()
    assert_shows(page, episode, 2)
    page.locator("#navigator").select_option(index=1)
    page.locator("#task").select_option(index=2)
    page.locator("#forward").click()
    assert_shows(page, data["navigators"][1]["episodes"][2], 1)
    page.evaluate("location.hash = 'navigator=2&task=3&step=4'")
    expect(page.locator("#now-step")).to_have_text(re.compile("^4 "))
    assert_shows(page, data["navigators"][1]["episodes"][2], 4)
    for name in NAMES:
        group = page.locator(f'#map g[data-element="{name}"]')
        assert group.locator("path").count() == len(data["contours"][name])
        page.locator(f"#show-{name}").uncheck()
        assert group.count() == 0
    page.locator("#all").check()
    assert vehicle.count() == 3
    assert texts(page)["title"] == HOSTILE
    assert page.locator("#navigator option").all_inner_texts() == ["secant", HOSTILE]
    assert page.locator("img").count() == 0

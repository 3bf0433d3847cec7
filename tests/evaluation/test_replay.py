"""The page that replays episodes: its numbers, its safety, and its behavior in a real browser."""

from __future__ import annotations

import importlib
import io
import itertools
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
from playwright.sync_api import Browser, Page, expect, sync_playwright
from tensordict.nn import TensorDictModule

from magrl.agents import FieldPolicy, save_policy
from magrl.agents.policy import PolicyConfig
from magrl.envs import GeomagneticNavEnv, Region, Scenario, Tasks, named_tasks
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.evaluation.replay import PIECES, episode_tracks, replay_data, write_gif, write_replay
from magrl.field import elements_at
from magrl.field.elements import NAMES
from magrl.geodesy import geodesic
from magrl.navigators import NAVIGATORS, Secant
from magrl.training import UsageError

RECIPES = Path(__file__).parent.parent.parent / "recipes"
expect.set_options(timeout=20_000)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
HOSTILE = "</script><img src=x onerror=alert(1)><!-- ${1}"


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    tasks = Tasks(*(end[:3] for end in named_tasks("test-1000")))
    return GeomagneticNavEnv(Scenario(tasks=tasks), num_envs=3, seed=0)


@pytest.fixture(scope="module")
def rollouts(env: GeomagneticNavEnv) -> dict[str, Any]:
    return {name: evaluation_rollout(env, NAVIGATORS[name](env, "", 0)) for name in ("secant", "parallel")}


@pytest.fixture(scope="module")
def data(env: GeomagneticNavEnv, rollouts: dict[str, Any]) -> dict[str, Any]:
    named = {"secant": rollouts["secant"], HOSTILE: rollouts["parallel"]}
    return replay_data(named, env.field, env.region, zeta=env.zeta, title=HOSTILE)


@pytest.fixture(scope="module")
def path(data: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "replay.html"
    write_replay(path, data)
    return path


# The data


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
            np.testing.assert_allclose(
                np.sin(np.radians(episode["heading_deg"])), np.sin(states["heading"])[:, 0], atol=2e-4
            )
            assert row["next", "done"][:count].flatten().tolist() == [False] * (count - 1) + [True]


def test_measures_are_those_of_the_metrics(data: dict[str, Any], rollouts: dict[str, Any]) -> None:
    for navigator, rollout in zip(data["navigators"], rollouts.values(), strict=True):
        measures = episode_measures(rollout)
        for key in ("steps", "shortest_km", "length_km", "navigation_error_km", "spl"):
            got = [episode[key] for episode in navigator["episodes"]]
            np.testing.assert_allclose(got, measures[key], atol=6e-5)
        for episode in navigator["episodes"]:
            assert episode["outcome"] == "arrived"
            assert episode["path_km"][-1] == pytest.approx(episode["length_km"], abs=2e-3)
            assert episode["distance_km"][-1] == pytest.approx(episode["navigation_error_km"], abs=2e-3)
            assert episode["distance_km"][0] == pytest.approx(episode["shortest_km"], abs=2e-3)


def test_tasks_are_those_of_the_environment(data: dict[str, Any], env: GeomagneticNavEnv) -> None:
    np.testing.assert_allclose([task["start"] for task in data["tasks"]], env.tasks.start, atol=6e-6)
    np.testing.assert_allclose([task["target"] for task in data["tasks"]], env.tasks.target, atol=6e-6)
    np.testing.assert_allclose(
        [task["field"] for task in data["tasks"]], elements_at(env.field, env.tasks.target), atol=2e-3
    )


def test_pieces_of_a_leg_are_equal_and_on_its_geodesic(env: GeomagneticNavEnv, rollouts: dict[str, Any]) -> None:
    for track in episode_tracks(rollouts["secant"], env.region):
        pieces, _ = geodesic(*track[:-1].T, *track[1:].T)
        legs, _ = geodesic(*track[:-PIECES:PIECES].T, *track[PIECES::PIECES].T)
        np.testing.assert_allclose(
            pieces.reshape(-1, PIECES), legs.unsqueeze(-1).expand(-1, PIECES) / PIECES, atol=1e-2
        )


def test_no_track_breaks_at_the_antimeridian() -> None:
    region = Region((-10, 0), (175, 185))
    tasks = Tasks(*(torch.tensor([end], dtype=torch.float64) for end in ((-5.0, 179.0), (-5.0, -178.0))))
    env = GeomagneticNavEnv(Scenario(region=region, tasks=tasks), num_envs=1, seed=0)
    rollout = evaluation_rollout(env, NAVIGATORS["parallel"](env, "", 0))
    data = replay_data({"parallel": rollout}, env.field, region, zeta=env.zeta)
    longitude = np.array(data["navigators"][0]["episodes"][0]["track"])[:, 1]
    assert longitude[0] == pytest.approx(179)
    assert longitude[-1] == pytest.approx(182, abs=0.2)
    assert np.abs(np.diff(longitude)).max() < 0.5
    assert data["tasks"][0]["target"] == [-5.0, 182.0]
    assert [task["name"] for task in data["tasks"]] == [str(k + 1) for k in range(len(data["tasks"]))]
    names = [f"task <{k}>" for k in range(len(data["tasks"]))]
    named = replay_data({"parallel": rollout}, env.field, region, zeta=env.zeta, names=names)
    assert [task["name"] for task in named["tasks"]] == names
    with pytest.raises(ValueError, match=rf"one name for each of {len(names)} tasks, got \['a', 'b', 'c', 'd', 'e'\]"):
        replay_data({"parallel": rollout}, env.field, region, zeta=env.zeta, names="abcde")
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
    fewer = {"secant": rollouts["secant"], "parallel": rollouts["parallel"][:2]}
    with pytest.raises(ValueError, match="'parallel' is of other tasks"):
        replay_data(fewer, env.field, env.region, zeta=0.01)


# The page as a file


def test_the_page_asks_for_nothing(path: Path) -> None:
    text = path.read_text()
    markup = re.sub(r'(id="replay-data">).*?(</script>)', r"\1\2", text, flags=re.DOTALL)
    assert not re.findall(
        r"""(?:src|href)\s*=(?!\s*"data:)|@import|url\(|fetch\(|XMLHttp|https?:(?!//www\.w3\.org)""", markup
    )
    assert "default-src 'none'" in text
    assert len(text) < 200_000


def test_names_cannot_break_out_of_the_data(path: Path) -> None:
    text = path.read_text()
    assert text.count("</script>") == 2
    assert "<img" not in text
    assert written(path)["title"] == written(path)["navigators"][1]["label"] == HOSTILE


def test_non_finite_values_are_refused(data: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        write_replay(tmp_path / "a.html", data | {"zeta": float("nan")})
    assert not (tmp_path / "a.html").exists()


# The animated GIF


def test_gif_shows_the_vehicles_moving(env: GeomagneticNavEnv, tmp_path: Path) -> None:
    rollout = evaluation_rollout(env, Secant(probe_km=10.0))  # moves that a picture shows: equal frames are merged
    write_gif(tmp_path / "a.gif", rollout, env.field, env.region, frames_per_step=1, size_px=320)
    picture = Image.open(tmp_path / "a.gif")
    steps = int(episode_measures(rollout)["steps"].max())
    assert picture.size == (320, 320)
    assert picture.n_frames == steps + 1
    assert picture.info["loop"] == 0
    frames = []
    for index in range(picture.n_frames):
        picture.seek(index)
        frames.append(np.asarray(picture.convert("RGB")))
    assert all((before != after).any() for before, after in itertools.pairwise(frames))
    assert (frames[0] == frames[-1]).all(-1).mean() > 0.9  # the map itself stands still


# The recipe


@pytest.fixture
def recipe(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(RECIPES))
    return importlib.import_module("replay")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run whose agent has learned nothing."""
    folder = tmp_path_factory.mktemp("runs") / "agent"
    folder.mkdir()
    torch.manual_seed(0)
    view = GeomagneticNavEnv(seed=0).observation_view()
    save_policy(folder / "policy.pt", FieldPolicy(PolicyConfig(view, (8,), layer_norm=False)))
    (folder / "config.json").write_text(json.dumps({"guided": True, "zeta": 2.9}))
    return folder


def test_the_recipe_flies_the_run_first(recipe: Any, run: Path, tmp_path: Path) -> None:
    out = recipe.replay(recipe.Config(run, num_tasks=2, gif=tmp_path / "a.gif"))
    assert out == run / "replay.html"
    data = written(out)
    labels = [navigator["label"] for navigator in data["navigators"]]
    assert labels == ["Gradient-Guided TD3", "secant (quasi-Newton)", "parallel (true gradient, an oracle)"]
    assert {len(navigator["episodes"]) for navigator in data["navigators"]} == {2}
    assert data["zeta"] == 2.9  # that of the run, under which nearly any move arrives
    assert "agent" in data["title"]
    assert Image.open(tmp_path / "a.gif").n_frames > 1


def test_a_policy_of_another_recipe_has_the_name_of_its_run(recipe: Any, run: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(run, tmp_path / "sac-seed0")
    (folder / "config.json").write_text(json.dumps({"recipe": "sac.py", "zeta": 0.01}))
    data = written(recipe.replay(recipe.Config(folder, navigators=(), num_tasks=2)))
    assert [navigator["label"] for navigator in data["navigators"]] == ["sac-seed0"]


def test_a_declaration_elsewhere_is_a_false_arrival(recipe: Any, run: Path, tmp_path: Path) -> None:
    box = {"latitude": [-10.0, 0.0], "longitude": [160.0, 170.0]}
    content = {"region": box, "date": "2022-01-01", "generation": 13, "arrival": "declared", "arrival_radius_km": 0.001}
    path = tmp_path / "declared.json"
    path.write_text(json.dumps(content | {"tasks": [{"start": [-2.0, 162.0], "target": [-8.0, 164.0]}]}))
    data = written(recipe.replay(recipe.Config(run, ("secant", "geodesic"), scenario=path, zeta=0.01)))
    outcomes = {each["label"]: each["episodes"][0]["outcome"] for each in data["navigators"]}
    assert set(outcomes.values()) <= {"arrived", "false arrival", "out of steps", "lost"}


def test_two_agents_of_a_kind_are_told_apart(recipe: Any, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    names = (f"gg_td3={run}", "pso:flown")
    assert recipe.replay(recipe.Config(run, names, tasks="figure-4-1", out=out, zeta=0.01)) == out
    labels = [navigator["label"] for navigator in written(out)["navigators"]]
    assert labels == ["Gradient-Guided TD3", "Gradient-Guided TD3 (agent)", "PSO, flown"]


def test_bad_usage_is_refused_before_anything_is_written(recipe: Any, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    (tmp_path / "file").touch()
    cases: list[tuple[dict[str, Any], str]] = [
        ({"navigators": ("dowsing",)}, "unknown navigator 'dowsing'"),
        ({"navigators": ("secant", "secant")}, "secant is given twice"),
        ({"num_tasks": 0}, "num_tasks must be a whole number from 1 up to 1000, got 0"),
        ({"num_tasks": 101, "tasks": "paper-100"}, "from 1 up to 100, got 101"),
        ({"num_tasks": 2, "tasks": "figure-4-1"}, "from 1 up to 1, got 2"),
        ({"run": Path("nowhere")}, "no run at nowhere"),
        ({"zeta": 0.0}, "zeta"),
        ({"zeta": 5.0}, "zeta must be below 3, got 5.0"),
        ({"gif": tmp_path / "file" / "a.gif"}, "cannot write .*a.gif"),
        ({"out": tmp_path / "file" / "page.html"}, "cannot write .*page.html"),
    ]
    for options, message in cases:
        with pytest.raises(UsageError, match=message):
            recipe.replay(recipe.Config(**({"run": run, "out": out} | options)))
        assert not out.exists()


def test_the_scenario_and_kind_are_those_of_the_training(recipe: Any, run: Path, tmp_path: Path) -> None:
    """The tasks of the file in the run folder, whatever the path in its settings; a run without guidance is TD3."""
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    settings = {"guided": False, "zeta": 0.5, "scenario": "elsewhere/scenario.json"}
    (folder / "config.json").write_text(json.dumps(settings))
    tasks = [{"start": [-2.0, 162.0], "target": [-8.0, 164.0]}, {"start": [-3.0, 163.0], "target": [-6.0, 165.0]}]
    box = {"latitude": [-10.0, 0.0], "longitude": [160.0, 170.0]}
    (folder / "scenario.json").write_text(json.dumps({"region": box, "date": "2022-01-01", "tasks": tasks}))
    data = written(recipe.replay(recipe.Config(folder, navigators=())))
    assert [task["start"] for task in data["tasks"]] == [task["start"] for task in tasks]
    assert [navigator["label"] for navigator in data["navigators"]] == ["TD3"]
    assert data["zeta"] == 0.5
    assert data["title"] == "run, tasks of scenario.json"


def test_a_damaged_configuration_is_refused(recipe: Any, tmp_path: Path) -> None:
    for content in ("[1]", "{", "5"):
        (tmp_path / "config.json").write_text(content)
        with pytest.raises(ValueError, match="not the configuration of a run"):
            recipe.run_config(tmp_path)


# The page in a browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A headless Chromium. With MAGRL_REQUIRE_BROWSER set, as .ci/run does, none is a failure."""
    if CHROMIUM is None:
        say = pytest.fail if os.environ.get("MAGRL_REQUIRE_BROWSER") else pytest.skip
        say("there is no Chromium on the PATH: apt-get install chromium")
    with sync_playwright() as playwright:
        # A container's root may not use Chromium's sandbox; the page is our own and asks for nothing.
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(browser: Browser, path: Path) -> Iterator[Page]:
    """The page, opened from disk; at the end nothing was complained of and nothing else was asked for."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    said, asked = [], []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("dialog", lambda dialog: (said.append(dialog.message), dialog.dismiss()))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(path.as_uri())
    yield page
    assert said == []
    assert [url for url in asked if not url.startswith("data:")] == [path.as_uri()]
    page.close()


def texts(page: Page) -> dict[str, str]:
    """What every element that has an id reads, with ASCII signs."""
    found = page.evaluate("Object.fromEntries([...document.querySelectorAll('[id]')].map((e) => [e.id, e.innerText]))")
    return {name: (text or "").replace("−", "-") for name, text in found.items()}


def assert_shows(page: Page, episode: dict[str, Any], step: int) -> None:
    """The read-outs are those of an episode at a step."""
    shown, near = texts(page), partial(pytest.approx, abs=0.051)
    assert shown["now-step"] == f"{step} of {episode['steps']}"
    said = re.match(r"Step (\d+) of (\d+), ([\d.]+) km to the destination", shown["status"])
    assert [float(number) for number in said.groups()] == near([step, episode["steps"], episode["distance_km"][step]])
    for name in ("distance", "path", "move"):
        assert float(shown[f"now-{name}"]) == near(episode[f"{name}_km"][step])
    assert float(shown["now-heading"].strip("°")) == near(episode["heading_deg"][step])
    assert float(shown["now-objective"]) == pytest.approx(episode["objective"][step], rel=0.06)
    for name, value in zip(NAMES, episode["field"][step], strict=True):
        assert float(shown[f"here-{name}"].split()[0]) == pytest.approx(value, abs=0.51 if name == "B_H" else 6e-4)
    assert shown["outcome"] == episode["outcome"]
    assert shown["steps"] == str(episode["steps"])
    assert float(shown["spl"]) == near(100 * episode["spl"])
    for name, key in (("length", "length_km"), ("shortest", "shortest_km"), ("error", "navigation_error_km")):
        assert float(shown[name]) == near(episode[key])


def test_it_plays_to_the_end(page: Page, data: dict[str, Any]) -> None:
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
    assert page.get_by_label("Step", exact=True).input_value() == str(episode["steps"])
    assert vehicle.get_attribute("transform") != start
    assert "arrived" in vehicle.get_attribute("class")
    page.get_by_role("button", name="Play").click()  # and starts anew
    expect(page.locator("#now-step")).not_to_have_text(f"{episode['steps']} of {episode['steps']}")


def test_another_navigator_and_task(page: Page, data: dict[str, Any]) -> None:
    assert page.locator("#navigator option").all_inner_texts()[0] == "secant"
    assert page.locator("#task option").count() == 3
    seen = set()
    for navigator, task in ((0, 0), (1, 0), (1, 2), (0, 1)):
        page.locator("#navigator").select_option(index=navigator)
        page.locator("#task").select_option(index=task)
        page.locator("#forward").click()
        assert_shows(page, data["navigators"][navigator]["episodes"][task], 1)
        seen.add((texts(page)["length"], texts(page)["here-D"], page.locator("#map .trail").get_attribute("d")))
    assert len(seen) == 4


def test_slider_keys_and_buttons_step(page: Page, data: dict[str, Any]) -> None:
    episode = data["navigators"][0]["episodes"][0]
    for key, step in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", episode["steps"]), ("Home", 0)):
        page.keyboard.press(key)
        assert_shows(page, episode, step)
    page.get_by_label("Step", exact=True).fill("3")
    assert_shows(page, episode, 3)
    page.get_by_role("button", name="One step back").click()
    assert_shows(page, episode, 2)
    page.locator("body").click(position={"x": 5, "y": 5})
    page.keyboard.press("Space")
    expect(page.locator("#play")).to_have_text("Pause")
    page.keyboard.press("Space")
    expect(page.locator("#play")).to_have_text("Play")


def test_a_link_leads_to_a_moment(page: Page, data: dict[str, Any]) -> None:
    page.evaluate("location.hash = 'navigator=2&task=3&step=4'")
    expect(page.locator("#now-step")).to_have_text(re.compile("^4 "))
    assert_shows(page, data["navigators"][1]["episodes"][2], 4)
    page.evaluate("location.hash = 'navigator=99&task=x&step=-5'")
    expect(page.locator("#now-step")).to_have_text(re.compile("^0 "))
    assert_shows(page, data["navigators"][1]["episodes"][0], 0)


def test_names_are_shown_as_text(page: Page) -> None:
    assert texts(page)["title"] == HOSTILE
    assert page.locator("#navigator option").all_inner_texts()[1] == HOSTILE
    assert HOSTILE in texts(page)["others"]
    assert page.locator("img").count() == 0


def test_contours_and_vehicles_can_be_chosen(page: Page, data: dict[str, Any]) -> None:
    for name in NAMES:
        group = page.locator(f'#map g[data-element="{name}"]')
        assert group.locator("path").count() == len(data["contours"][name])
        assert group.locator("text").count() > 2
        expect(group.locator("path").first).to_be_visible()
        page.locator(f"#show-{name}").uncheck()
        assert group.count() == 0
    assert page.locator("#map .vehicle").count() == 1
    page.locator("#all").check()
    assert page.locator("#map .vehicle").count() == 3
    page.locator("#map").click()
    page.keyboard.press("End")
    assert "3 of 3 have arrived" in texts(page)["status"]


def colors(page: Page) -> np.ndarray:
    """The colors of a screenshot, the most frequent one first."""
    pixels = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).reshape(-1, 3)
    packed, counts = np.unique(pixels @ np.array([65536, 256, 1]), return_counts=True)
    packed = packed[np.argsort(-counts)]
    return np.stack([packed >> 16, packed >> 8 & 255, packed & 255], -1)


def palette(page: Page) -> dict[str, np.ndarray]:
    """The page's named colors in the scheme that it is shown in."""
    read = "getComputedStyle(document.documentElement).getPropertyValue('--' + name)"
    names = ("page", "card", "ink", "muted", "accent", *NAMES)
    found = page.evaluate(f"Object.fromEntries({json.dumps(names)}.map((name) => [name, {read}]))")
    return {name: np.array([int(text.strip()[at : at + 2], 16) for at in (1, 3, 5)]) for name, text in found.items()}


def contrast(one: np.ndarray, other: np.ndarray) -> float:
    """The contrast ratio of the Web Content Accessibility Guidelines: 4.5 is enough to read by."""
    linear = [np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) for c in (one / 255, other / 255)]
    dark, light = sorted(float(c @ [0.2126, 0.7152, 0.0722]) for c in linear)
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize(("scheme", "low", "high"), [("light", 230, 255), ("dark", 0, 40)])
def test_it_is_drawn_and_can_be_read(page: Page, scheme: str, low: int, high: int) -> None:
    page.emulate_media(color_scheme=scheme)
    shown, named = colors(page), palette(page)
    assert len(shown) > 500
    assert low <= shown[0].mean() <= high
    for name, color in named.items():
        assert (np.abs(shown - color).max(1) < 8).any(), f"nothing is in the color of {name}"
        if name not in ("page", "card"):
            assert contrast(color, named["card"]) > 4.5, name
    assert contrast(named["muted"], named["page"]) > 4.5
    assert contrast(named["ink"], named["page"]) > 4.5


@pytest.mark.parametrize("width", [390, 820])
def test_it_fits_narrow_screens(page: Page, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 844})
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert page.evaluate("document.documentElement.scrollWidth") == width
    assert page.evaluate("$('map').clientWidth === $('map').firstChild.viewBox.baseVal.width")  # drawn anew, not scaled
    for name in ("map", "play", "chart-F"):
        box = page.locator(f"#{name}").bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
        assert box["height"] > 20


def test_everything_that_can_be_operated_has_a_name(page: Page) -> None:
    nameless = page.evaluate(
        "[...document.querySelectorAll('button, select, input')].filter((each) =>"
        " !(each.getAttribute('aria-label') || each.textContent.trim() || each.labels?.[0]?.textContent.trim()))"
        ".map((each) => each.id)"
    )
    assert nameless == []
    assert page.locator("#status").get_attribute("aria-live") == "polite"
    assert page.locator("#step").get_attribute("aria-valuetext").startswith("step 0 of")


def test_who_wants_less_motion_sees_steps(page: Page) -> None:
    page.emulate_media(reduced_motion="reduce")
    page.evaluate("goTo(1)")
    at_one = page.locator("#map .vehicle").get_attribute("transform")
    page.evaluate("state.time = 1.5; show()")
    assert page.locator("#map .vehicle").get_attribute("transform") == at_one
    page.emulate_media(reduced_motion="no-preference")
    page.evaluate("show()")
    assert page.locator("#map .vehicle").get_attribute("transform") != at_one

"""Tracks for maps: written files are read again with a standard parser, and hold the positions of the episodes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from magrl.envs import GeomagneticNavEnv
from magrl.evaluation.export import Track, check_suffix, cut, to_geojson, tracks, write_tracks

AWKWARD = 'a <b> & "c" \x00\x1f ]]> Ñandú'
STRAIGHT = Track(AWKWARD, [(10.123456789, 20.987654321), (11.0, 21.5), (1e-7, -1e-7)], {"spl": 0.5, "steps": 2})
ACROSS = Track("across", [(0.0, 178.0), (1.0, -179.0), (2.0, 179.5)], {"spl": math.nan})


def test_tracks_are_those_of_the_rollout() -> None:
    env = GeomagneticNavEnv(num_envs=2, seed=0)
    rollout = env.rollout(4, break_when_any_done=False)
    one, other = tracks(rollout, ["one", "other"], navigator="chance")
    assert (one.name, other.name) == ("one", "other")
    assert one.positions[0] == tuple(rollout["position"][0, 0].tolist())
    assert one.positions[-1] == tuple(rollout["next", "position"][0, 3].tolist())
    assert len(one.positions) == 5
    assert (one.properties["navigator"], one.properties["steps"], one.properties["success"]) == ("chance", 4, False)
    assert {"spl", "length_km", "shortest_km", "navigation_error_km"} <= one.properties.keys()
    with pytest.raises(ValueError, match="each of 2 episodes, got 1"):
        tracks(rollout, ["one"])


def test_geojson_is_that_of_rfc_7946() -> None:
    collection = json.loads(to_geojson([STRAIGHT, ACROSS]))
    assert collection["type"] == "FeatureCollection"
    straight, across = collection["features"]
    assert straight["type"] == "Feature"
    assert straight["geometry"] == {
        "type": "LineString",
        "coordinates": [[20.987654321, 10.123456789], [21.5, 11.0], [-1e-7, 1e-7]],
    }
    assert straight["properties"] == {"name": AWKWARD, "spl": 0.5, "steps": 2}
    assert across["properties"]["spl"] is None, "JSON has no NaN"
    assert across["geometry"]["type"] == "MultiLineString"
    first, second, third = across["geometry"]["coordinates"]
    assert first == [[178.0, 0.0], [180.0, pytest.approx(2 / 3)]]
    assert second == [[-180.0, pytest.approx(2 / 3)], [-179.0, 1.0], [-180.0, pytest.approx(1 + 1 / 1.5)]]
    assert third == [[180.0, pytest.approx(1 + 1 / 1.5)], [179.5, 2.0]]


@pytest.mark.parametrize(
    ("places", "lines"),
    [
        ([(0, 180), (0, -179)], [[(0, -180), (0, -179)]]),
        ([(0, 179), (0, -180)], [[(0, 179), (0, 180)]]),
        ([(0, 179), (1, 180), (2, -179)], [[(0, 179), (1, 180)], [(1, -180), (2, -179)]]),
        ([(0, 180), (1, -180), (2, 180)], [[(0, -180), (1, -180), (2, -180)]]),
        ([(0, -179), (1, 179)], [[(0, -179), (0.5, -180)], [(0.5, 180), (1, 179)]]),
        ([(0, -1), (1, 1)], [[(0, -1), (1, 1)]]),
    ],
)
def test_lines_are_cut_at_the_antimeridian_alone(places: list, lines: list) -> None:
    assert cut(places) == lines


@pytest.mark.parametrize("places", [[(0, 0)], [(0, 0), (91, 0)], [(0, 0), (0, 181)], [(0, 0), (math.nan, 0)]], ids=str)
def test_what_cannot_be_drawn_is_refused(places: list) -> None:
    with pytest.raises(ValueError, match=r"itude must be|two positions"):
        to_geojson([Track("bad", places, {})])


def test_the_file_is_geojson_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "new" / "tracks.GeoJSON"
    write_tracks(path, [STRAIGHT])
    assert path.read_text(encoding="utf-8") == to_geojson([STRAIGHT])
    with pytest.raises(ValueError, match=r"must end in \.geojson, got 'a\.kml'"):
        check_suffix("a.kml")
    with pytest.raises(ValueError, match=r"must end in \.geojson"):
        write_tracks(tmp_path / "tracks", [STRAIGHT])

"""Tracks for maps: written files are read again with a standard parser, and hold the positions of the episodes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from magrl.envs import GeomagneticNavEnv
from magrl.evaluation.export import check_suffix, cut, feature, tracks, write_tracks

AWKWARD = 'a <b> & "c" \x00\x1f ]]> Ñandú'
PLACES = [(10.123456789, 20.987654321), (11.0, 21.5), (1e-7, -1e-7)]
STRAIGHT = feature(PLACES, {"name": AWKWARD, "spl": 0.5, "steps": 2})
ACROSS = feature([(0.0, 178.0), (1.0, -179.0), (2.0, 179.5)], {"spl": math.nan})


def test_tracks_are_those_of_the_rollout() -> None:
    env = GeomagneticNavEnv(num_envs=2, seed=0)
    rollout = env.rollout(4, break_when_any_done=False)
    one, other = tracks(rollout, ["one", "other"], navigator="chance")
    known, places = one["properties"], one["geometry"]["coordinates"]
    assert (known["name"], other["properties"]["name"]) == ("one", "other")
    assert places[0] == rollout["position"][0, 0].flip(-1).tolist()
    assert places[-1] == rollout["next", "position"][0, 3].flip(-1).tolist()
    assert len(places) == 5
    assert (known["navigator"], known["steps"], known["success"]) == ("chance", 4, False)
    assert {"spl", "length_km", "shortest_km", "navigation_error_km"} <= known.keys()
    with pytest.raises(ValueError, match="each of 2 episodes, got 1"):
        tracks(rollout, ["one"])


def test_a_file_is_that_of_rfc_7946(tmp_path: Path) -> None:
    path = tmp_path / "new" / "tracks.GeoJSON"
    write_tracks(path, [STRAIGHT, ACROSS])
    collection = json.loads(path.read_text(encoding="utf-8"))
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
    assert across["geometry"]["coordinates"][0] == [[178.0, 0.0], [180.0, pytest.approx(2 / 3)]]


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


def test_the_file_is_geojson_by_its_name(tmp_path: Path) -> None:
    for call in (check_suffix, lambda path: write_tracks(path, [STRAIGHT])):
        with pytest.raises(ValueError, match=r"must end in \.geojson, got '.*a\.kml'"):
            call(tmp_path / "a.kml")

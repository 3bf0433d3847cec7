"""Tracks for maps: written files are read again with the standard parsers, and hold the positions of the episodes."""

from __future__ import annotations

import json
import math
from pathlib import Path
from xml.etree import ElementTree

import pytest

from magrl.envs import GeomagneticNavEnv
from magrl.evaluation.export import Track, check_suffix, cut, to_geojson, to_gpx, to_kml, tracks, write_tracks
from magrl.evaluation.navigators import NAVIGATOR_COLORS

GPX, KML = "{http://www.topografix.com/GPX/1/1}", "{http://www.opengis.net/kml/2.2}"
AWKWARD = 'a <b> & "c" \x00\x1f ]]> Ñandú'
STRAIGHT = Track(AWKWARD, [(10.123456789, 20.987654321), (11.0, 21.5), (1e-7, -1e-7)], {"spl": 0.5, "steps": 2})
ACROSS = Track("across", [(0.0, 178.0), (1.0, -179.0), (2.0, 179.5)], {"spl": math.nan})


def gpx_places(text: str) -> list[list[tuple[float, float]]]:
    root = ElementTree.fromstring(text)
    assert (root.tag, root.get("version")) == (f"{GPX}gpx", "1.1")
    segments = root.findall(f"{GPX}trk/{GPX}trkseg")
    return [[(float(p.get("lat")), float(p.get("lon"))) for p in track.findall(f"{GPX}trkpt")] for track in segments]


def kml_lines(text: str) -> list[list[list[tuple[float, float]]]]:
    root = ElementTree.fromstring(text)
    assert root.tag == f"{KML}kml"
    lines = []
    for shape in root.findall(f"{KML}Document/{KML}Placemark/{KML}MultiGeometry"):
        lines.append([])
        for line in shape.findall(f"{KML}LineString/{KML}coordinates"):
            triples = [tuple(map(float, triple.split(","))) for triple in line.text.split()]
            assert all(len(triple) == 3 and triple[2] == 0 for triple in triples)
            lines[-1].append([(latitude, longitude) for longitude, latitude, _ in triples])
    return lines


def same(one: list[tuple[float, float]], other: list[tuple[float, float]]) -> bool:
    pairs = zip(one, other, strict=True)
    return all(abs(a - b) < 1e-7 for p, q in pairs for a, b in zip(p, q, strict=True))


def test_tracks_are_those_of_the_rollout() -> None:
    env = GeomagneticNavEnv(num_envs=2, seed=0)
    rollout = env.rollout(4, break_when_any_done=False)
    one, other = tracks(rollout, ["one", "other"], navigator="chance")
    assert (one.name, other.name) == ("one", "other")
    assert one.positions[0] == tuple(rollout["position"][0, 0].tolist())
    assert one.positions[-1] == tuple(rollout["next", "position"][0, 3].tolist())
    assert len(one.positions) == 5
    assert one.target == tuple(rollout["target_position"][0, 0].tolist())
    assert (one.properties["navigator"], one.properties["steps"], one.properties["success"]) == ("chance", 4, False)
    assert {"spl", "length_km", "shortest_km", "navigation_error_km"} <= one.properties.keys()
    with pytest.raises(ValueError, match="each of 2 episodes, got 1"):
        tracks(rollout, ["one"])


def test_geojson_is_that_of_rfc_7946() -> None:
    text = to_geojson([STRAIGHT, ACROSS])
    assert "<" not in text, "a text can end the script element of a page"
    collection = json.loads(text)
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


def test_gpx_holds_the_places() -> None:
    text = to_gpx([STRAIGHT, ACROSS])
    straight, across = gpx_places(text)
    assert same(straight, STRAIGHT.positions)
    assert same(across, ACROSS.positions)
    assert "e-" not in text.lower().split("<trkseg>")[1], "GPX reads no powers of ten"
    assert ElementTree.fromstring(text).find(f"{GPX}trk/{GPX}name").text == 'a <b> & "c" ?? ]]> Ñandú'
    assert gpx_places(to_gpx([Track("edge", [(0, 180), (0, 179)], {})]))[0][0] == (0, -180)


def test_kml_holds_the_places_and_is_cut() -> None:
    text = to_kml([STRAIGHT, ACROSS])
    straight, across = kml_lines(text)
    assert same(straight[0], STRAIGHT.positions)
    assert [len(line) for line in across] == [2, 3, 2]
    assert (across[0][-1][1], across[1][0][1]) == (180, -180)
    assert ElementTree.fromstring(text).find(f".//{KML}name").text.startswith("a <b> &")


def test_kml_has_a_folder_and_a_color_for_each_navigator_and_the_ends_once() -> None:
    """Two runs of one navigator and one of another on two tasks; in KML, all styles stand before the first folder."""
    ends = {"home": ((10.0, 20.0), (11.0, 21.0)), "port": ((12.0, 22.0), (13.0, 179.0))}
    flown = [
        Track(name, [start, (start[0], start[1] + 1)], {"navigator": navigator, "run": run}, target)
        for navigator, run in (("td3", 0), ("td3", 1), ("secant", 0))
        for name, (start, target) in ends.items()
    ]
    document = ElementTree.fromstring(to_kml(flown)).find(f"{KML}Document")
    assert [part.tag for part in document] == [f"{KML}Style"] * 5 + [f"{KML}Folder"] * 4
    *navigators, last = document.findall(f"{KML}Folder")
    assert [folder.find(f"{KML}name").text for folder in navigators] == ["td3, run 0", "td3, run 1", "secant"]
    colors = {f"#{style.get('id')}": style.find(f"*/{KML}color").text for style in document.findall(f"{KML}Style")}
    drawn = []
    for folder in navigators:
        placemarks = folder.findall(f"{KML}Placemark")
        assert [place.find(f"{KML}name").text for place in placemarks] == ["home", "port"]
        drawn += {colors[place.find(f"{KML}styleUrl").text] for place in placemarks}
    expected = (NAVIGATOR_COLORS[name] for name in ("td3", "td3", "secant"))
    assert drawn == [f"ff{color[5:]}{color[3:5]}{color[1:3]}".lower() for color in expected]
    names = [place.find(f"{KML}name").text for place in last.findall(f"{KML}Placemark")]
    assert names == [f"{name}: {end}" for name in ends for end in ("start", "destination")]
    places = [part.text for part in last.iter(f"{KML}coordinates")]
    assert places[2:] == ["22.000000000,12.000000000,0", "179.000000000,13.000000000,0"]
    assert {"#start", "#destination"} <= colors.keys()


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
    for writer in (to_geojson, to_gpx, to_kml):
        with pytest.raises(ValueError, match=r"itude must be|two positions"):
            writer([Track("bad", places, {})])


def test_format_goes_by_the_suffix(tmp_path: Path) -> None:
    for suffix, start in ((".geojson", '{"type"'), (".gpx", "<?xml"), (".KML", "<?xml")):
        path = tmp_path / "new" / f"tracks{suffix}"
        write_tracks(path, [STRAIGHT])
        assert path.read_text(encoding="utf-8").startswith(start)
    with pytest.raises(ValueError, match=r"\.geojson, \.gpx, \.kml, got 'a\.shp'"):
        check_suffix("a.shp")
    with pytest.raises(ValueError, match="must end in one of"):
        write_tracks(tmp_path / "tracks", [STRAIGHT])

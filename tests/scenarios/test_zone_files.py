"""Obstacles from GeoJSON: corners in metres, and errors that name file, feature and what was expected."""

import json

import pytest

from uav_dc_ros import scenarios
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.scenarios import zone_files

DATUM = (47.4, 8.5)
# 300 m east and north of the datum: a degree of latitude is 111.18 km here, and one of longitude 75.46 km.
RING = [[8.504, 47.4027], [8.505, 47.4027], [8.505, 47.4036], [8.504, 47.4036], [8.504, 47.4027]]


def feature(rings=None, kind="Polygon", **properties):
    """A GeoJSON feature."""
    geometry = {"type": kind, "coordinates": [RING] if rings is None else rings}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def collection(*features, **more):
    """A GeoJSON text."""
    return json.dumps({"type": "FeatureCollection", "features": features, **more})


@pytest.fixture
def scenario(tmp_path):
    """A scenario file beside a file of zones with this text; its path."""

    def write(text, datum="datum_deg = [47.4, 8.5]", own=""):
        (tmp_path / "zones.geojson").write_text(text, "utf-8")
        shipped = scenarios.find("five_clusters_hover").read_text("utf-8")
        shipped = shipped.replace("[radio]", "[radio]\nobstruction_loss_db = 20.0")
        path = tmp_path / "mine.toml"
        path.write_text(f'zones = "zones.geojson"\n{datum}\n{shipped}{own}', "utf-8")
        return path

    return write


def test_zones_of_a_file_follow_those_of_the_scenario(scenario):
    parts = [[RING], [[[x + 0.002, y] for x, y in RING]]]
    text = collection(
        feature(name="school"),
        feature(kind="MultiPolygon", rings=parts) | {"properties": {"height_m": 40, "kind": "building"}},
    )
    own = "\n[[obstacles]]\npolygon_m = [[850, 450], [950, 450], [950, 550]]\nheight_m = 9.0\n"
    loaded = scenarios.load(scenario(text, own=own))
    assert [one.kind for one in loaded.obstacles] == ["building", "no_fly", "building", "building"]
    assert [one.height_m for one in loaded.obstacles] == [9.0, None, 40.0, 40.0]
    school = loaded.obstacles[1]
    assert school.name == "school"
    assert len(school.polygon_m) == 4
    x_m, y_m = school.polygon_m[0]
    assert (x_m, y_m) == pytest.approx((301.8, 300.2), abs=0.2)
    assert loaded.obstacles[3].polygon_m[0][0] == pytest.approx(x_m + 150.9, abs=0.2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "Input data was truncated; expected a GeoJSON FeatureCollection of polygons"),
        (collection(), "no polygons; expected at least one"),
        (
            collection(feature(), crs={"properties": {"name": "EPSG:3857"}}),
            "crs = 'EPSG:3857'; expected longitude",
        ),
        (
            collection(feature(kind="Point")),
            "Invalid value 'Point' - at `$.geometry.type`; expected a Polygon",
        ),
        (collection(feature([RING, RING])), "a polygon of 2 rings; expected one: no holes"),
        (
            collection(feature([RING[:-1]])),
            "an outline of 4 positions; expected 4 or more, the last one equal",
        ),
        (
            collection(feature(hight_m=3)),
            "unknown property 'hight_m'; expected name, kind, height_m, base_m, cl",
        ),
        (collection(feature(height_m="3")), "height_m = '3'; expected float, got str"),
        (collection(feature(height_m=-3)), "height_m = -3; expected float > 0.0"),
        (
            collection(feature([[[8.5, 147.4], [8.6, 47.4], [8.5, 47.5], [8.5, 147.4]]])),
            "latitude = 147.4; expec",
        ),
        ("{}", "Object missing required field `features`; expected a GeoJSON Feature"),
    ],
)
def test_errors_name_the_file_and_the_feature(scenario, text, message):
    path = scenario(text)
    with pytest.raises(ScenarioError) as caught:
        scenarios.load(path)
    zones = path.parent / "zones.geojson"
    where = f"{zones}: " if ", feature 0" not in str(caught.value) else f"{zones}, feature 0: "
    assert str(caught.value).startswith(f"{where}{message}")


def test_errors_of_the_scenario(scenario, tmp_path):
    with pytest.raises(ScenarioError, match=r"positions in degrees; expected datum_deg in the scenario"):
        scenarios.load(scenario(collection(feature()), datum=""))
    with pytest.raises(ScenarioError, match=r"mine\.toml: datum_deg\[0\] = 'a'; expected float, got str"):
        scenarios.load(scenario(collection(feature()), datum='datum_deg = ["a", 3.0]'))
    crossed = [RING[i] for i in (0, 2, 1, 3, 0)]
    with pytest.raises(
        ScenarioError, match=r"mine\.toml: obstacles\[0\] 'x': polygon_m: the edge after corner 0"
    ):
        scenarios.load(scenario(collection(feature([crossed], name="x"))))
    with pytest.raises(ScenarioError, match=r"zones\.geojson: cannot be read"):
        zone_files.read(tmp_path / "no" / "zones.geojson", DATUM)

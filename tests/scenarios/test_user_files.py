"""Users from CSV and GeoJSON files: values, degrees to metres, and one clear line for each mistake."""

import json
import re
from pathlib import Path

import numpy as np
import pymap3d
import pytest

from tests.doc_commands import blocks
from uav_dc_ros import scenario as command
from uav_dc_ros import scenarios
from uav_dc_ros.core.users.settings import User
from uav_dc_ros.errors import ScenarioError

TEXT = scenarios.find("five_clusters_hover").read_text("utf-8")
TEXT = re.sub(
    r"(?s)\[users\].*?\[mission\]", "[users]\nfile = 'users.csv'\nv_max_mps = 1.0\n\n[mission]", TEXT
)
DATUM = (47.397742, 8.545594)
METRES = """name,x_m,y_m,cluster,radius_m,data_bits,priority
gate,300,800.5,b,,,
"pump, old",8e2,200,,,,3
mast,500,500,b,20,2e6,
"""


@pytest.fixture
def load(tmp_path):
    """The scenario with a file of users."""

    def make(content, name="users.csv", datum=None, binary=False):
        head = "" if datum is None else f"datum_deg = {list(datum)}\n"
        text = head + TEXT.replace("users.csv", name)
        (tmp_path / "mine.toml").write_text(text, "utf-8")
        if content is not None:
            (tmp_path / name).write_bytes(content if binary else content.encode())
        return scenarios.load(tmp_path / "mine.toml")

    return make


def collection(*features, **members):
    return json.dumps({"type": "FeatureCollection", "features": list(features), **members})


def point(longitude, latitude, **properties):
    return {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": [longitude, latitude]},
        "properties": properties,
    }


def test_csv_in_metres(load):
    scenario = load(METRES)
    assert scenario.users.user == (
        User(x_m=300.0, y_m=800.5, name="gate", cluster="b"),
        User(x_m=800.0, y_m=200.0, name="pump, old", priority=3.0),
        User(x_m=500.0, y_m=500.0, name="mast", cluster="b", radius_m=20.0, data_bits=2e6),
    )
    assert scenario.users.file is None, "the scenario holds the users themselves"
    again = load(METRES.replace("\n", "\r\n").replace(",x_m", " , x_m"))
    assert again == scenario
    assert again.fingerprint == scenario.fingerprint
    windows = load("\ufeff" + METRES)
    assert windows == scenario
    assert load(METRES.replace("800.5", "800.6")).fingerprint != scenario.fingerprint


def test_degrees_are_metres_east_and_north_of_the_datum(load):
    """Both ways to write them; the way back is pymap3d's, to a millimetre."""
    degrees = [(47.4, 8.55), (47.3985, 8.546), (47.40412345678, 8.5561)]
    rows = "\n".join(f"{latitude},{longitude},u{i}" for i, (latitude, longitude) in enumerate(degrees))
    csv = load(f"latitude,longitude,name\n{rows}\n", datum=DATUM)
    features = [point(longitude, latitude, name=f"u{i}") for i, (latitude, longitude) in enumerate(degrees)]
    geojson = load(collection(*features), name="users.geojson", datum=DATUM)
    assert csv == geojson
    for user, (latitude, longitude) in zip(csv.users.user, degrees, strict=True):
        back = pymap3d.enu2geodetic(user.x_m, user.y_m, 0.0, *DATUM, 0.0)
        np.testing.assert_allclose(back[:2], (latitude, longitude), rtol=0, atol=1e-8)
    assert csv.datum_deg == DATUM
    # At the equator a degree of longitude is a 360th of its circle of 6,378,137 m.
    (user,) = load("latitude,longitude\n0.0,0.005\n", datum=(0.0, 0.0)).users.user
    assert user.x_m == pytest.approx(6_378_137.0 * np.sin(np.radians(0.005)), rel=1e-12)
    assert user.y_m == 0.0


def test_a_crs_that_is_wgs_84_is_accepted(load):
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    there = point(8.55, 47.4, cluster=None, priority=2)
    scenario = load(collection(there, crs=crs), name="users.geojson", datum=DATUM)
    assert scenario.users.user[0].priority == 2.0


CSV = {
    "": "users.csv: no header; expected the columns x_m and y_m, or latitude and longitude; optionally name,",
    "x_m,y_m\n": "users.csv: no users; expected at least one",
    "x_m,name\n1,a\n": "users.csv, line 1: no column y_m; expected x_m and y_m, or latitude and longitude;",
    "name\na\n": "users.csv, line 1: no column x_m;",
    "latitude\n1\n": "users.csv, line 1: no column longitude;",
    "x_ft,y_ft\n1,2\n": "users.csv, line 1: unknown column 'x_ft'; expected x_m and y_m,",
    "x_m;y_m\n1;2\n": "users.csv, line 1: unknown column 'x_m;y_m'; expected x_m and y_m,",
    "x_m,y_m,data_mbit\n1,2,3\n": "users.csv, line 1: unknown column 'data_mbit'; expected",
    "x_m,y_m,x_m\n1,2,3\n": "users.csv, line 1: column 'x_m' twice; expected it once",
    "x_m,y_m,latitude\n1,2,3\n": "users.csv, line 1: x_m and latitude; expected positions in metres or in",
    "x_m,y_m\n1,2\n\n1\n": "users.csv, line 4: 1 fields; expected 2, as in line 1",
    "x_m,y_m\n1,\n": "users.csv, line 2: no y_m; expected a number",
    "x_m,y_m\n1,2 m\n": "users.csv, line 2: y_m = '2 m'; expected a finite number, such as 12.5",
    "x_m,y_m\n1,1_0\n": "users.csv, line 2: y_m = '1_0'; expected a finite number",
    "x_m,y_m\n1,nan\n": "users.csv, line 2: y_m = 'nan'; expected a finite number",
    "x_m,y_m\n-inf,1\n": "users.csv, line 2: x_m = '-inf'; expected a finite number",
    "x_m,y_m,priority\n1,1,0\n": "users.csv, line 2: priority = 0.0; expected float > 0.0",
    "x_m,y_m,radius_m\n1,1,-2\n": "users.csv, line 2: radius_m = -2.0; expected float >= 0.0",
    f"x_m,y_m,name\n1,1,{65 * 'a'}\n": f"users.csv, line 2: name = '{65 * 'a'}'; expected str of length <",
    'x_m,y_m\n1,"2\n': "users.csv, line 2: unexpected end of data; expected CSV",
    "x_m,y_m,name\n1,1,a\n2,2,a\n": "mine.toml: users.user[1].name = 'a', as of users.user[0]; expected",
    "x_m,y_m\n1,1\n5000,2\n": "mine.toml: users.user[1] = [5000.0, 2.0]; expected a position over the grid:",
    "latitude,longitude\n47.4,8.55\n": "users.csv: positions in degrees; expected datum_deg in the scenario",
    None: "users.csv: cannot be read:",
    b"x_m,y_m\n\xff,1\n": "users.csv: cannot be read:",
}


@pytest.mark.parametrize("content", CSV)
def test_csv_errors(content, load, tmp_path, capsys):
    with pytest.raises(ScenarioError) as caught:
        load(content, binary=isinstance(content, bytes))
    assert str(caught.value).startswith(f"{tmp_path}/{CSV[content]}")
    with pytest.raises(SystemExit) as exit:
        command.main(["check", str(tmp_path / "mine.toml")])
    assert exit.value.code == 2
    lines = capsys.readouterr().err.splitlines()  # a user far outside is also out of reach
    assert len(lines) == (2 if isinstance(content, str) and "5000" in content else 1)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "users.geojson: Input data was truncated; expected a GeoJSON FeatureCollection of points"),
        (
            '{"type": "Feature"}',
            "users.geojson: Invalid value 'Feature' - at `$.type`; expected a GeoJSON FeatureCollection",
        ),
        (collection(), "users.geojson: no users; expected at least one"),
        (
            collection(point(8.5, 47.4), crs={"properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}),
            "users.geojson: crs = 'urn:ogc:def:crs:EPSG::3857'; expected longitude and latitude on WGS 84",
        ),
        (
            collection(point(8.5, 47.4), point(8.5, 90.5)),
            "users.geojson, feature 1: latitude = 90.5; expected degrees on WGS 84, from -90 to 90",
        ),
        (
            collection(point(949_000.0, 6_000_000.0)),
            "users.geojson, feature 0: latitude = 6e+06; expected degrees on WGS 84",
        ),
        (
            collection({"type": "Feature", "geometry": {"type": "Polygon", "coordinates": []}}),
            "users.geojson, feature 0: Invalid value 'Polygon' - at `$.geometry.type`; expected a Point",
        ),
        (
            collection(point(8.55, 47.4, colour="red")),
            "users.geojson, feature 0: unknown property 'colour'; expected name, cluster, radius_m,",
        ),
        (
            collection(point(8.55, 47.4, cluster=3)),
            "users.geojson, feature 0: cluster = 3; expected str, got int",
        ),
        (
            collection(point(8.6, 47.4)),
            "mine.toml: users.user[0] = [",
        ),
    ],
)
def test_geojson_errors(content, message, load, tmp_path):
    with pytest.raises(ScenarioError) as caught:
        load(content, name="users.geojson", datum=DATUM)
    assert str(caught.value).startswith(f"{tmp_path}/{message}")


def test_other_errors_of_the_keys(load, tmp_path):
    (tmp_path / "users.txt").write_text(METRES)
    with pytest.raises(
        ScenarioError, match=r"users\.txt: a file of users; expected a name that ends in \.csv"
    ):
        load(METRES, name="users.txt")
    with pytest.raises(ScenarioError, match=r"datum_deg\[0\] = 91.0; expected float <= 90.0"):
        load(METRES, datum=(91.0, 0.0))
    text = TEXT.replace("v_max_mps", "user = []\nv_max_mps")
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(ScenarioError, match=r"users\.file = 'users\.csv' beside users\.user; expected one"):
        scenarios.load(tmp_path / "mine.toml")
    (tmp_path / "mine.toml").write_text(TEXT.replace("'users.csv'", "3"))
    with pytest.raises(ScenarioError, match=r"users\.file = 3; expected str, got int"):
        scenarios.load(tmp_path / "mine.toml")


def test_the_example_of_the_page(load, tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "users.md").read_text("utf-8")
    (example,) = (one for one in blocks(page, "toml") if "users.csv" in one)
    (users,) = blocks(page, "csv")
    head, table = example.split("\n\n", 1)
    text = re.sub(r"(?s)\[users\].*?\[mission\]", lambda _: f"{table}\n\n[mission]", TEXT)
    (tmp_path / "users.csv").write_text(users)
    (tmp_path / "mine.toml").write_text(f"{head}\n{text}")
    scenario = scenarios.load(tmp_path / "mine.toml")
    assert scenario.users.names == ("gate", "yard", "pump")
    assert scenario.users.sizes == (2, 1)

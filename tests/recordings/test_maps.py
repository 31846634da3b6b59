"""`bag export --gpx`, `--kml`, `--geojson`: places that independent readers find where the core has them."""

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import msgspec
import numpy as np
import pymap3d
import pytest

from tests.bags.test_foreign import run
from tests.recordings import made
from tests.recordings.report_bags import diagnostics
from tests.support.worlds import tiny
from uav_dc_ros import topics
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.recordings.step_reader import Steps
from uav_dc_ros.scenarios import user_files

Capture = pytest.CaptureFixture[str]
DATUM = (47.397742, 8.545594)
WORLD = msgspec.structs.replace(tiny(), datum_deg=DATUM)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two missions in a scenario with a datum."""
    return made.write(
        tmp_path_factory.mktemp("flown") / "B", made.flight(WORLD, missions=2), made.about(WORLD)
    )


def test_geojson_has_the_path_and_users_that_a_scenario_reads_again(
    flown: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = run(capsys, "export", flown, "--geojson", "--out", tmp_path / "m.geojson")
    assert "2 missions, 18 poses, datum 47.3977, 8.54559" in out
    features = json.loads((tmp_path / "m.geojson").read_text())["features"]
    lines = [one for one in features if one["geometry"]["type"] == "LineString"]
    with BagReader(flown) as reader:
        steps = list(Steps(reader, "", WORLD.step_ns))
    for line in lines:
        own = [step for step in steps if step.mission == line["properties"]["mission"]]
        longitude, latitude, altitude = np.asarray(line["geometry"]["coordinates"]).T
        assert altitude.tolist() == [step.position_m[2] for step in own]
        _, _, up = pymap3d.geodetic2enu(latitude, longitude, altitude, *DATUM, 0.0)
        x_m, y_m, _ = pymap3d.geodetic2enu(latitude, longitude, altitude - (up - altitude), *DATUM, 0.0)
        expected = np.asarray([step.position_m for step in own])
        assert np.abs(np.asarray([x_m, y_m]).T - expected[:, :2]).max() < 1e-3
        last = own[-1]
        assert line["properties"]["outcome"] == last.status.phase.value
        assert line["properties"]["users_collected"] == sum(last.rates.collected)
    # A scenario reads users from such a file, in metres again.
    users = [
        one for one in features if one["geometry"]["type"] == "Point" and one["properties"]["mission"] == 1
    ]
    assert [one["properties"]["collected"] for one in users] == steps[-1].rates.collected
    assert [one["properties"]["data_bits"] for one in users] == steps[-1].rates.data_bits
    bare = [{**one, "properties": {}} for one in users]
    (tmp_path / "u.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": bare}))
    read = user_files.read(tmp_path / "u.geojson", DATUM)
    found = np.asarray([(user["x_m"], user["y_m"]) for user in read])
    expected = np.asarray([steps[-1].users.x_m, steps[-1].users.y_m]).T
    assert np.abs(found - expected).max() < 1e-3


def test_gpx_and_kml_are_xml_with_every_pose_and_user(flown: Path, tmp_path: Path, capsys: Capture) -> None:
    for name in ("gpx", "kml"):
        run(capsys, "export", flown, f"--{name}", "--datum", "1,2,400", "--out", tmp_path / f"m.{name}")
    gpx, kml = (ET.parse(tmp_path / f"m.{name}").getroot() for name in ("gpx", "kml"))
    space = {"g": "http://www.topografix.com/GPX/1/1", "k": "http://www.opengis.net/kml/2.2"}
    assert gpx.get("version") == "1.1"
    assert [one.tag.rpartition("}")[2] for one in gpx] == [
        "metadata",
        *["wpt"] * 8,
        "trk",
        "trk",
    ]  # its order
    points = gpx.findall("g:trk/g:trkseg/g:trkpt", space)
    assert len(points) == 18
    assert points[0].findtext("g:time", "", space) == "2023-11-14T22:13:20.000Z"
    altitude_m = float(points[0].findtext("g:ele", "", space))
    assert altitude_m == pytest.approx(400 + WORLD.grid.altitude_min_m, abs=0.01)
    lines = kml.findall("k:Document/k:Folder/k:Placemark/k:LineString", space)
    assert [line.findtext("k:altitudeMode", "", space) for line in lines] == ["absolute"] * 2
    coordinates = [tuple(map(float, at.split(","))) for at in lines[0][1].text.split()]  # type: ignore[union-attr]
    of_gpx = [(float(p.get("lon", "")), float(p.get("lat", ""))) for p in points[:9]]
    assert [(longitude, latitude) for longitude, latitude, _ in coordinates] == of_gpx
    assert len(kml.findall("k:Document/k:Folder/k:Placemark/k:Point", space)) == 8
    styles = {one.get("id") for one in kml.findall("k:Document/k:Style", space)}
    assert {one.text[1:] for one in kml.iterfind(".//k:styleUrl", space)} <= styles  # type: ignore[index]


def test_the_datum_of_a_bridge_s_flight_is_in_the_bag(tmp_path: Path, capsys: Capture) -> None:
    """Its diagnostics hold it; between steps its path has more poses."""
    world = tiny()
    recorded = made.flight(world, missions=1)
    extra = recorded[3]._replace(
        topic="/pose",
        type=topics.POSE,
        data=made.pose((50.0, 0.0, 100.0), 1),
        log_time_ns=recorded[3].log_time_ns + 1,
    )
    reports = [
        BagMessage("/diagnostics", topics.DIAGNOSTICS, diagnostics(name, 0, "", {"grid": grid}), at_ns, at_ns)
        for name, grid in (("bridge", "local 1,2,3 m"), ("bridge", "47.0,8.0,488.25"), ("other", "1,2,3"))
        for at_ns in [recorded[0].log_time_ns]
    ]
    about = made.about(world, vehicle="mavlink")
    bag = made.write(
        tmp_path / "bag", sorted([*recorded, extra, *reports], key=lambda m: m.log_time_ns), about
    )
    out = run(capsys, "export", bag, "--geojson", "--out", tmp_path / "m.geojson")
    assert "1 mission, 10 poses, datum 47, 8, 488.25" in out
    (line, *_) = json.loads((tmp_path / "m.geojson").read_text())["features"]
    assert line["geometry"]["coordinates"][0] == pytest.approx([8.0, 47.0, 588.25], abs=1e-6)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--gpx", "--out", "{new}.kml"], "expected a file NAME.gpx for gpx"),
        (["--gpx", "--kml", "--out", "{new}.gpx"], "--kml: not allowed with argument --gpx"),
        (["--gpx", "--out", "{new}.gpx", "--datum", "91,0"], "datum '91,0'; expected LATITUDE,LONGITUDE"),
        (["--gpx", "--out", "{new}.gpx", "--datum", "nan,0"], "datum 'nan,0'; expected LATITUDE,LONGITUDE"),
        (["--gpx", "--out", "{new}.gpx", "--tables", "steps"], "--tables applies to tables only"),
        (["--out", "{new}", "--datum", "1,2"], "--datum applies to --gpx, --kml, --geojson only"),
        (["--gpx", "--out", "{new}.gpx"], "gives a datum; expected --datum LATITUDE"),
    ],
)
def test_maps_that_cannot_be_drawn(
    tmp_path: Path, capsys: Capture, options: list[str], expected: str
) -> None:
    bag = made.write(tmp_path / "bag", made.flight(tiny(), steps=1), made.about(tiny()))
    given = [option.format(new=tmp_path / "new") for option in options]
    assert expected in run(capsys, "export", bag, *given, status=2)
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]

"""Recorded missions on a map: the path and the users as GPX, KML or GeoJSON, on WGS 84.

A path has each recorded pose of its mission; users are where they were at the mission's last users.
"""

import contextlib
import importlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import groupby
from operator import attrgetter
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

from uav_dc_ros import __version__, topics
from uav_dc_ros.bags.message_definitions import typestore
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError, ParameterError, UavDcError
from uav_dc_ros.recordings.recorded_step import MissionTotals, RecordedPose, RecordedStep, mission_name
from uav_dc_ros.recordings.step_reader import Steps, read_pose

STYLES = {
    "collected": "ff6e8c2a",
    "waiting": "ff2c50c9",
    "path": "ff7e3f2b",
}  # of KML: alpha, blue, green, red
_EXPECTED = "LATITUDE,LONGITUDE or LATITUDE,LONGITUDE,ALTITUDE, degrees and metres"


class Datum(NamedTuple):
    """Position of the grid's x = 0, y = 0 on WGS 84. Without an altitude, heights are above the ground."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None = None

    @classmethod
    def parse(cls, text: str) -> "Datum":
        """The datum in a text; raises ParameterError if it is none."""
        try:
            found = cls(*map(float, text.split(",")))
            latitude, longitude, altitude = found
            if abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude or 0.0) <= 1e5:
                return found
        except (TypeError, ValueError):
            pass
        raise ParameterError(f"datum {text!r}; expected {_EXPECTED}")


class Point(NamedTuple):
    """A place on WGS 84; `altitude_m` as that of the datum; `time_ns`: of a pose, when it was published."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    time_ns: int = 0


@dataclass(kw_only=True)
class MapMission:
    """A mission on a map."""

    flight: int
    mission: int
    totals: MissionTotals = field(default_factory=MissionTotals)
    path: list[Point] = field(default_factory=list)
    users: list[tuple[Point, dict[str, Any]]] = field(default_factory=list)  # with their properties

    @property
    def properties(self) -> dict[str, Any]:
        """The result of the mission; without what is unknown."""
        totals = self.totals
        values = {
            "name": mission_name(self.mission, self.flight),
            "seed": totals.seed,
            "scenario": totals.scenario,
            "outcome": totals.outcome,
            "steps": totals.steps,
            "users_collected": totals.collected,
            "users_total": totals.users,
            "data_bits": totals.data_bits,
        }
        return {key: value for key, value in values.items() if value is not None}


def recorded_datum(reader: BagReader, namespace: str) -> Datum | None:
    """The last datum that the bridge of a real vehicle reports in its diagnostics; None: it reports none."""
    found = None
    for message in reader.messages([f"{namespace}/diagnostics"]):
        try:
            array: Any = typestore().deserialize_cdr(message.data, topics.DIAGNOSTICS)
        except Exception:  # of struct, numpy, rosbags: unreadable diagnostics of another system
            continue
        for status in array.status:
            for pair in status.values if status.name == "bridge" else ():
                if pair.key == "grid" and pair.value.count(",") == 2:
                    try:
                        found = Datum.parse(pair.value)
                    except ParameterError:
                        continue  # of a local frame
    return found


def find_datum(reader: BagReader, namespace: str, scenario: Scenario, given: str | None) -> Datum:
    """The datum `given`, or that of the flight, or the scenario's; raises ParameterError without any."""
    if given is not None:
        return Datum.parse(given)
    if (found := recorded_datum(reader, namespace)) is not None:
        return found
    if scenario.datum_deg is None:
        raise ParameterError(
            f"bag {reader.path}: neither its vehicle nor its scenario {scenario.name!r} gives a datum; "
            f"expected --datum {_EXPECTED}"
        )
    return Datum(*scenario.datum_deg)


def read_missions(
    reader: BagReader, namespace: str, recorded: Steps, datum: Datum, real: bool
) -> list[MapMission]:
    """The missions of a bag. The paths of a `real` vehicle have the poses between steps, too."""
    convert = _to_degrees(datum)
    missions: list[MapMission] = []
    spans: list[tuple[int, int]] = []  # log times of the missions, ns
    for (flight, number), steps in groupby(recorded, attrgetter("flight", "mission")):
        mission, last = MapMission(flight=flight, mission=number), _Last()
        times_ns: list[int] = []
        for step in steps:
            mission.totals.add(step.step, step.status, step.rates)
            last.add(step)
            times_ns += [*step.log_ns.values(), *(report.log_ns for report in step.phase_reports)]
            if not real and step.poses:
                mission.path.append(convert(step.poses[0]))
        mission.users = list(last.users(convert))
        missions.append(mission)
        spans.append((min(times_ns), max(times_ns)))
    if real and missions:
        _add_poses(reader, f"{namespace}/pose", missions, spans, convert)
    return missions


def _add_poses(
    reader: BagReader,
    topic: str,
    missions: Sequence[MapMission],
    spans: Sequence[tuple[int, int]],
    convert: "Callable[[RecordedPose], Point]",
) -> None:
    """Add each pose to the mission in whose time it was received."""
    for _, message in reader.received([topic]) if topic in reader.topics else ():
        for mission, (start_ns, end_ns) in zip(missions, spans, strict=True):
            if start_ns <= message.log_time_ns <= end_ns:
                with contextlib.suppress(MessageError):  # `Steps` counts it
                    mission.path.append(convert(read_pose(message)))
                break


class _Last:
    """The last users and rates of a mission, and when each user was collected."""

    def __init__(self) -> None:
        self._users: RecordedStep | None = None
        self._rates: RecordedStep | None = None
        self._collected_step: dict[int, int] = {}

    def add(self, step: RecordedStep) -> None:
        if step.users is not None:
            self._users = step
        if step.rates is not None:
            self._rates = step
            for user, collected in enumerate(step.rates.collected):
                if collected:
                    self._collected_step.setdefault(user, step.step)

    def users(self, convert: "Callable[[RecordedPose], Point]") -> Iterator[tuple[Point, dict[str, Any]]]:
        if self._users is None or self._users.users is None:
            return
        users = self._users.users
        rates = self._rates.rates if self._rates is not None else None
        for user, (x_m, y_m, cluster) in enumerate(zip(users.x_m, users.y_m, users.cluster, strict=True)):
            values: dict[str, Any] = {"name": f"user {user}", "cluster": cluster}
            if rates is not None and user < len(rates.collected):
                values |= {"collected": rates.collected[user], "data_bits": rates.data_bits[user]}
                if user in self._collected_step:
                    values["collected_step"] = self._collected_step[user]
            place: Any = (x_m, y_m, 0.0)
            yield convert(RecordedPose(0, place, 0, 0)), values


def _to_degrees(datum: Datum) -> Callable[[RecordedPose], Point]:
    """Conversion of positions in metres from the datum's tangential plane, exact on WGS 84."""
    try:
        pymap3d: Any = importlib.import_module("pymap3d")
    except ImportError:
        raise UavDcError(
            "maps need pymap3d; expected it installed: pip install 'uav_dc_ros[mavlink]'"
        ) from None

    def convert(pose: RecordedPose) -> Point:
        x_m, y_m, z_m = map(float, pose.position_m)
        latitude, longitude, altitude = pymap3d.enu2geodetic(
            x_m, y_m, z_m, *datum[:2], datum.altitude_m or 0.0
        )
        altitude_m = z_m if datum.altitude_m is None else float(altitude)
        return Point(float(latitude), float(longitude), altitude_m, pose.publish_ns)

    return convert


def _numbers(point: Point) -> tuple[str, str, str]:
    """Latitude, longitude (a hundredth of a millimetre) and altitude (a millimetre) as text."""
    return f"{point.latitude_deg:.10f}", f"{point.longitude_deg:.10f}", f"{point.altitude_m:.3f}"


def gpx(missions: Sequence[MapMission], datum: Datum, title: str) -> bytes:
    """GPX 1.1: a track for each mission, and a waypoint for each of its users."""
    attributes = {"version": "1.1", "creator": f"uav_dc_ros {__version__}"}
    root = ET.Element("gpx", {**attributes, "xmlns": "http://www.topografix.com/GPX/1/1"})
    ET.SubElement(ET.SubElement(root, "metadata"), "name").text = title
    for mission in missions:
        for point, values in mission.users:
            _gpx_point(root, "wpt", point, f"{values['name']}, {mission.properties['name']}", values)
    for mission in missions:
        track = ET.SubElement(root, "trk")
        ET.SubElement(track, "name").text = mission.properties["name"]
        ET.SubElement(track, "desc").text = _text(mission.properties)
        segment = ET.SubElement(track, "trkseg")
        for point in mission.path:
            _gpx_point(segment, "trkpt", point)
    return _xml(root)


def _gpx_point(
    parent: ET.Element, tag: str, point: Point, name: str = "", values: dict[str, Any] | None = None
) -> None:
    latitude, longitude, altitude = _numbers(point)
    element = ET.SubElement(parent, tag, {"lat": latitude, "lon": longitude})
    ET.SubElement(element, "ele").text = altitude
    if point.time_ns:
        time = datetime.fromtimestamp(point.time_ns // 10**6 / 1e3, UTC)
        ET.SubElement(element, "time").text = time.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    if values is not None:
        ET.SubElement(element, "name").text = name
        ET.SubElement(element, "desc").text = _text(values)


def kml(missions: Sequence[MapMission], datum: Datum, title: str) -> bytes:
    """KML 2.2: a folder for each mission, with its path and users."""
    root = ET.Element("kml", {"xmlns": "http://www.opengis.net/kml/2.2"})
    document = ET.SubElement(root, "Document")
    ET.SubElement(document, "name").text = title
    for style, colour in STYLES.items():
        element = ET.SubElement(document, "Style", {"id": style})
        kind, size = ("LineStyle", "width") if style == "path" else ("IconStyle", "scale")
        shape = ET.SubElement(element, kind)
        ET.SubElement(shape, "color").text = colour
        ET.SubElement(shape, size).text = "3" if style == "path" else "0.6"
    mode = "relativeToGround" if datum.altitude_m is None else "absolute"
    for mission in missions:
        folder = ET.SubElement(document, "Folder")
        ET.SubElement(folder, "name").text = mission.properties["name"]
        path = _placemark(folder, "path", mission.properties)
        line = ET.SubElement(path, "LineString")
        ET.SubElement(line, "altitudeMode").text = mode
        ET.SubElement(line, "coordinates").text = " ".join(map(_kml_point, mission.path))
        for point, values in mission.users:
            user = _placemark(folder, "collected" if values.get("collected") else "waiting", values)
            ET.SubElement(ET.SubElement(user, "Point"), "coordinates").text = _kml_point(point)
    return _xml(root)


def _placemark(folder: ET.Element, style: str, values: dict[str, Any]) -> ET.Element:
    element = ET.SubElement(folder, "Placemark")
    ET.SubElement(element, "name").text = values["name"]
    ET.SubElement(element, "styleUrl").text = f"#{style}"
    data = ET.SubElement(element, "ExtendedData")
    for key, value in values.items():
        entry = ET.SubElement(data, "Data", {"name": key})
        ET.SubElement(entry, "value").text = _value(value)
    return element


def _kml_point(point: Point) -> str:
    latitude, longitude, altitude = _numbers(point)
    return f"{longitude},{latitude},{altitude}"


def geojson(missions: Sequence[MapMission], datum: Datum, title: str) -> bytes:
    """GeoJSON (RFC 7946): a line for each mission with two poses, and a point for each of its users."""

    def feature(kind: str, coordinates: Any, values: dict[str, Any]) -> dict[str, Any]:
        geometry = {"type": kind, "coordinates": coordinates}
        return {"type": "Feature", "geometry": geometry, "properties": values}

    def position(point: Point) -> list[float]:
        latitude, longitude, altitude = map(float, _numbers(point))
        return [longitude, latitude, altitude]

    features = []
    for mission in missions:
        of = {"mission": mission.mission, "flight": mission.flight}
        if len(mission.path) > 1:
            line = list(map(position, mission.path))
            features.append(feature("LineString", line, {**mission.properties, **of}))
        features += [
            feature("Point", position(point)[:2], {**values, **of}) for point, values in mission.users
        ]
    return json.dumps({"type": "FeatureCollection", "features": features}).encode() + b"\n"


WRITERS: dict[str, Callable[[Sequence[MapMission], Datum, str], bytes]] = {
    "gpx": gpx,
    "kml": kml,
    "geojson": geojson,
}


def _text(values: dict[str, Any]) -> str:
    return ", ".join(f"{key} {_value(value)}" for key, value in values.items() if key != "name")


def _value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _xml(root: ET.Element) -> bytes:
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"

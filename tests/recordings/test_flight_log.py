"""`bag log`: logs in both formats, with a clock and an origin of their own, are found in the bag's time."""

import csv
import importlib.util
import math
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.bags.test_foreign import run
from tests.recordings import made, report_bags
from tests.support.worlds import tiny
from uav_dc_ros import topics
from uav_dc_ros.bags.read import BagMessage
from uav_dc_ros.recordings.flight_log.align import align

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pyulog") is None, reason="the extra log is not installed"
)
Capture = pytest.CaptureFixture[str]
OFFSET_S = 17.35  # of the bag's time when the autopilot started
ORIGIN_M = np.array([120.0, -40.0, 80.0])  # of the autopilot, in the bag's frame
CLOCK_AHEAD_S = 1.25  # the bag's clock before GPS
LENGTH_S = 60.0
MODES = ((0.0, 4, "GUIDED"), (50.0, 9, "LAND"))


def place_m(at_s: float) -> np.ndarray:
    """Where the vehicle is, by the bag's time."""
    return np.array([40 * math.sin(at_s / 7), 25 * math.cos(at_s / 11), 100 + 10 * math.sin(at_s / 5)])


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The path at 10 Hz, with a tenth of a metre of noise."""
    noise, world = np.random.default_rng(0), tiny()
    recorded = made.flight(world, steps=0)[2:3]  # a mission's status
    for n in range(round(LENGTH_S * 10)):
        at_ns = made.BEGUN_NS + n * 10**8
        data = made.pose((place_m(n / 10) + noise.normal(0, 0.1, 3)).tolist(), at_ns)
        recorded.append(BagMessage("/pose", topics.POSE, data, at_ns + 10**6, at_ns))
    about = made.about(world, vehicle="mavlink")
    return made.write(tmp_path_factory.mktemp("flown") / "B", recorded, about)


Samples = Iterable[tuple[int, np.ndarray]]


def samples() -> Iterator[tuple[int, np.ndarray]]:
    """Time since the autopilot's start, microseconds, and its own place (east, north, up), at 25 Hz."""
    for n in range(25 * 40):
        at_s = 2.0 + n / 25
        yield round(at_s * 1e6), place_m(at_s + OFFSET_S - 0.001) - ORIGIN_M  # the bag begins with a receipt


def ardupilot(path: Path, flown: Samples | None = None) -> Path:
    """A dataflash log of `flown`, by default `samples()`: formats, then messages."""
    kinds = {
        "XKF1": ("QBfff", "TimeUS,C,PN,PE,PD"),
        "BAT": ("QBff", "TimeUS,Inst,Volt,Curr"),
        "GPS": ("QBBIH", "TimeUS,I,Status,GMS,GWk"),
        "MODE": ("QMBB", "TimeUS,Mode,ModeNum,Rsn"),
        "MSG": ("QZ", "TimeUS,Message"),
        "ERR": ("QBB", "TimeUS,Subsys,ECode"),
    }
    codes = {"Q": "Q", "B": "B", "M": "B", "f": "f", "I": "I", "H": "H", "Z": "64s"}
    structs = {
        name: struct.Struct("<" + "".join(codes[c] for c in form)) for name, (form, _) in kinds.items()
    }
    numbers = {name: 129 + i for i, name in enumerate(kinds)}
    file = bytearray()

    def add(type: int, content: bytes) -> None:
        file.extend(b"\xa3\x95" + bytes([type]) + content)

    own = struct.Struct("<BB4s16s64s")
    add(128, own.pack(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns"))
    for name, (form, columns) in kinds.items():
        size = structs[name].size + 3
        add(128, own.pack(numbers[name], size, name.encode(), form.encode(), columns.encode()))

    def message(name: str, *values: object) -> None:
        add(numbers[name], structs[name].pack(*values))

    starts_utc_s = made.BEGUN_NS / 1e9 + OFFSET_S - CLOCK_AHEAD_S
    for at_s, number, _ in MODES[:1]:
        message("MODE", round((at_s + 1) * 1e6), number, number, 1)
    for n, (at_us, own_m) in enumerate(flown or samples()):
        east, north, up = own_m
        message("XKF1", at_us, 0, north, east, -up)
        message("XKF1", at_us, 1, 0.0, 0.0, 0.0)  # the second estimator
        if n % 25 == 0:
            message("BAT", at_us, 0, 16.0 - n / 1000, 12.5)
            gps_s = starts_utc_s + at_us / 1e6 - 315_964_800 + 18
            message("GPS", at_us, 0, 4, round(gps_s % 604_800 * 1000), int(gps_s // 604_800))
        if n == 500:
            message("MSG", at_us, b"Mission: 1 WP")
            message("ERR", at_us, 12, 1)
            message("MODE", at_us, MODES[1][1], MODES[1][1], 1)
    path.write_bytes(file)
    return path


def px4(path: Path) -> Path:
    """A ULog."""
    file = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))

    def add(kind: bytes, content: bytes) -> None:
        file.extend(struct.pack("<H", len(content)) + kind + content)

    kinds = {
        "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;",
        "battery_status": "uint64_t timestamp;float voltage_v;float current_a;",
        "vehicle_status": "uint64_t timestamp;uint8_t nav_state;",
        "sensor_gps": "uint64_t timestamp;uint64_t time_utc_usec;uint8_t fix_type;",
    }
    for name, fields in kinds.items():
        add(b"F", f"{name}:{fields}".encode())
    for number, name in enumerate(kinds):
        add(b"A", struct.pack("<BH", 0, number) + name.encode())
    starts_utc_us = round((made.BEGUN_NS / 1e9 + OFFSET_S - CLOCK_AHEAD_S) * 1e6)
    for n, (at_us, own_m) in enumerate(samples()):
        east, north, up = own_m
        add(b"D", struct.pack("<HQfff", 0, at_us, north, east, -up))
        if n % 25 == 0:
            add(b"D", struct.pack("<HQff", 1, at_us, 16.0 - n / 1000, 12.5))
            add(b"D", struct.pack("<HQB", 2, at_us, 14 if n < 500 else 18))
            add(b"D", struct.pack("<HQQB", 3, at_us, starts_utc_us + at_us, 3))
        if n == 500:
            add(b"L", struct.pack("<BQ", ord("4"), at_us) + b"Failsafe activated")
    path.write_bytes(file)
    return path


@pytest.mark.parametrize(("make", "suffix"), [(ardupilot, ".bin"), (px4, ".ulg")])
def test_a_log_is_found_in_the_time_of_its_bag(
    bag: Path, tmp_path: Path, capsys: Capture, make: Callable[[Path], Path], suffix: str
) -> None:
    log = make(tmp_path / f"flight{suffix}")
    out = run(capsys, "log", bag, log, "--out", tmp_path / "log.csv").splitlines()
    offset_s = float(out[0].split("started at ")[1].split()[0])
    assert abs(offset_s - (OFFSET_S - 0.001)) < 0.01, "a tenth of the bag's sampling time"
    rms_m = float(out[1].split("differ by ")[1].split()[0])
    assert 0.1 < rms_m < 0.25, "the noise of the bag"
    assert "the bag's clock is 1.2" in out[2]
    assert "s ahead of GPS" in out[2]
    events = [line.split(" s  ") for line in out[3:-1]]
    at_s = 22.0 + offset_s
    assert [(round(float(when) - at_s, 2), what) for when, what in events][-1][0] == 0.0
    texts = [what for _, what in events]
    if suffix == ".bin":
        assert texts == ["mode GUIDED", "Mission: 1 WP", "error: subsystem 12, code 1", "mode LAND"]
    else:
        assert texts == ["mode OFFBOARD", "mode AUTO_LAND", "Failsafe activated"]
    with (tmp_path / "log.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1000
    middle = rows[300]
    place = [float(middle[name]) for name in ("x_m", "y_m", "altitude_m")]
    assert np.linalg.norm(np.asarray(place) - place_m(float(middle["time_s"]) + 0.001)) < 0.3
    assert float(middle["deviation_m"]) < 0.6
    assert float(middle["battery_v"]) == pytest.approx(15.7, abs=1e-3)
    modes = ("GUIDED", "LAND") if suffix == ".bin" else ("OFFBOARD", "AUTO_LAND")
    assert (rows[0]["mode"], rows[-1]["mode"]) == modes


def test_logs_of_other_flights_and_no_logs(bag: Path, tmp_path: Path, capsys: Capture) -> None:
    log = ardupilot(tmp_path / "flight.bin")
    other = made.write(tmp_path / "other", made.flight(tiny()), made.about(tiny()))
    error = run(capsys, "log", other, log, status=2)
    assert "of the path in bag" in error
    assert "expected the log of the same flight, or --offset S" in error
    assert "started at 5.000 s" in run(capsys, "log", bag, log, "--offset", 5)
    (tmp_path / "junk.ulg").write_bytes(b"no log")
    (tmp_path / "empty.bin").write_bytes(b"")
    for name, expected in (
        ("junk.ulg", "is damaged, or no log"),
        ("empty.bin", "empty.bin is empty; expected a log of"),
        ("none.bin", "cannot be read: No such file"),
        ("log.txt", "expected a log of ArduPilot (.bin) or PX4 (.ulg)"),
    ):
        assert expected in run(capsys, "log", bag, tmp_path / name, status=2)


def test_a_report_shows_the_log(bag: Path, tmp_path: Path, capsys: Capture) -> None:
    log, out = ardupilot(tmp_path / "flight.bin"), tmp_path / "page.html"
    run(capsys, "report", bag, "--log", log, "--out", out)
    shown = report_bags.unpacked(out)["data"]["log"]
    assert shown["offset_s"] == pytest.approx(OFFSET_S, abs=0.01)
    assert shown["ahead_of_gps_s"] == pytest.approx(CLOCK_AHEAD_S, abs=0.02)
    assert [event["text"] for event in shown["events"]][-2:] == ["error: subsystem 12, code 1", "mode LAND"]
    assert len(shown["s"]) == len(shown["deviation_m"]) == len(shown["battery_v"]) == 1000
    assert max(filter(None, shown["deviation_m"])) < 0.6
    assert shown["s"][0] == pytest.approx(OFFSET_S + 2.0, abs=0.02)
    run(capsys, "report", bag, "--log", log, "--log-offset", 3, "--out", out)
    assert report_bags.unpacked(out)["data"]["log"]["offset_s"] == 3.0


def test_a_log_of_no_page(bag: Path, tmp_path: Path, capsys: Capture) -> None:
    log = ardupilot(tmp_path / "flight.bin")
    alone = run(capsys, "report", bag, "--log-offset", 3, status=2)
    assert "--log-offset applies to --log only" in alone
    assert "expected no --compare" in run(capsys, "report", bag, "--log", log, "--compare", status=2)
    other = made.write(tmp_path / "other", made.flight(tiny()), made.about(tiny()))
    assert "or --log-offset S" in run(capsys, "report", other, "--log", log, status=2)


def test_a_path_that_stands_still_has_no_time() -> None:
    times_s = np.arange(0.0, 30.0, 0.1)
    still = np.zeros((len(times_s), 3))
    assert align(times_s, still, times_s, still) is None
    assert align(times_s, still, times_s, still, offset_s=100.0) is None

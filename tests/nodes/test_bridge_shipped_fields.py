"""Flights through real nodes in the shipped fields with obstacles, beside a fake autopilot on MAVLink."""

import itertools
import json
from pathlib import Path

import pytest

from tests.conftest import Ros
from tests.nodes.test_bridge import beside
from tests.offboard.test_obstacles_in_flight import keeps
from tests.offboard.test_shipped_fields import SETTINGS
from tests.recordings.report_bags import unpacked
from tests.support.fake_autopilot.flight import fake
from uav_dc_ros import bag as command
from uav_dc_ros import scenarios
from uav_dc_ros.offboard.frames import Enu, Ned, to_enu

RETURN = {"ardupilot": ("RTL_ALT", 100.0), "px4": ("RTL_RETURN_ALT", 1.0)}  # the parameter, and of a metre
FLOWN_M = 0.01  # the fake's metres, by way of degrees in 1e-7, are the grid's but for so much


@pytest.mark.long
@pytest.mark.parametrize(("kind", "wire", "name"), [("ardupilot", "tcp", "town"), ("px4", "udp", "farm")])
def test_a_shipped_field_is_flown_as_the_guide_says(
    ros: Ros, kind: str, wire: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the values of docs/obstacles.md. The bag is verified, and a report shows it."""
    scenario, (margin_m, return_m) = scenarios.load(name), SETTINGS[name]
    steps = scenario.mission.max_steps
    bridge = {"fence_margin_m": margin_m, "return_altitude_m": return_m, "land_if_return_blocked": "true"}
    given = ("--scenario", name, "--policy", f"{name}_dueling", "--seed", 3, "--arm", "--bag", "bag")
    settings = (word for key, value in bridge.items() for word in ("--set", f"bridge.{key}={value}"))
    with fake(kind, wire, speed=100.0) as autopilot:
        parameter, metre = RETURN[kind]
        autopilot.do("param", parameter, return_m * metre)
        status, output = ros.run_all(*beside(autopilot, *given, "--summary", "summary.json", *settings))
        report = autopilot.report()
    assert status == 0, output
    assert "Traceback" not in output
    summary = json.loads((ros.folder / "summary.json").read_text())
    assert (summary["outcome"], summary["steps"]) == ("landed", steps), output
    # Of 46 in the town and 16 in the farm 45 and 16. A busy machine may make a step late, which costs some.
    assert summary["users_collected"] > scenario.n_users / 2
    assert not report["armed"]
    north_m, east_m, _ = report["ned"]
    x_m, y_m, _ = scenario.mission.start_m
    assert (x_m + east_m, y_m + north_m) == pytest.approx(scenario.mission.dock_m, abs=2.0)

    setpoints = [to_enu(Ned(*event["ned"])) for event in autopilot.all("setpoint")]
    sent = [Enu(x_m + east, y_m + north, up) for east, north, up in setpoints]
    assert len(sent) > 20, "it flies among the obstacles"
    for way in itertools.pairwise(sent):
        assert all(keeps(one, *way, margin_m - FLOWN_M) for one in scenario.obstacles), way

    def run(verb: str, *arguments: object) -> str:
        with pytest.raises(SystemExit) as end:
            command.main([verb, str(ros.folder / "bag"), *map(str, arguments)])
        shown = capsys.readouterr()
        assert end.value.code == 0, shown
        return shown.out

    out = run("verify", "--complete")
    assert f"decisions: {steps} of {steps} steps recomputed, equal to the last bit" in out
    assert f"channel: {steps + 1} of {steps + 1} steps recomputed, equal to the last bit" in out
    assert "all changes are allowed; " in out
    assert f"{steps} moves were started, none twice" in out
    run("report", "--out", tmp_path / "report.html")
    world = unpacked(tmp_path / "report.html")["data"]["world"]
    assert [one["kind"] for one in world["obstacles"]] == [one.kind for one in scenario.obstacles]

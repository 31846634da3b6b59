"""Bags of missions that the core flies, for tests of reports: no nodes, and any fault that is wanted."""

import base64
import gzip
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from uav_dc_ros import cdr, messages, payloads, topics
from uav_dc_ros.bags.message_definitions import typestore
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.core import world
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.scenario import Scenario

START_NS = 1_700_000_000_000_000_000
LATENCY_NS = 2_000_000


def states(scenario: Scenario, seed: int, steps: int | None = None) -> Iterator[tuple[Any, Any, int]]:
    """State, link and next action of a mission that wanders about, from its start to its end."""
    rng = np.random.default_rng(seed)
    draws = (scenario.n_users, 2)
    state = world.initial(scenario, rng.random(draws))
    uav_m = scenario.grid.centre_m(state.cell, like=state.users_m)
    link = world.measure(scenario, uav_m, state.users_m, state.collected)
    for _ in range(scenario.mission.max_steps if steps is None else steps):
        action = int(rng.integers(len(ACTION_LABELS)))
        yield state, link, action
        state, outcome = world.step(scenario, state, np.asarray(action), rng.random(draws))
        link = outcome.link
    yield state, link, -1


def pose(time_ns: int, position_m: Any) -> bytes:
    """A geometry_msgs/PoseStamped in frame map, serialised."""
    types = typestore().types
    x, y, z = map(float, position_m)
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    place = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x=x, y=y, z=z), turn)
    made = types[topics.POSE](types["std_msgs/msg/Header"](stamp, "map"), place)
    return bytes(typestore().serialize_cdr(made, topics.POSE))


def diagnostics(name: str, level: int, message: str, values: dict[str, str]) -> bytes:
    """A diagnostic_msgs/DiagnosticArray with one status, serialised."""
    types = typestore().types
    pairs = [types["diagnostic_msgs/msg/KeyValue"](key=key, value=value) for key, value in values.items()]
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](level, name, message, "uav_dc_ros", pairs)
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "")
    return bytes(typestore().serialize_cdr(types[topics.DIAGNOSTICS](header, [status]), topics.DIAGNOSTICS))


def write(
    folder: Path,
    scenario: Scenario,
    *,
    seeds: tuple[int, ...] = (0,),
    about: dict[str, str] | None = None,
    leave_out: tuple[tuple[str, int], ...] = (),
    steps: int | None = None,
    extra: tuple[tuple[str, str, bytes], ...] = (),
) -> Path:
    """Write a bag; a step takes 10 ms of its recording, a message 2 ms from its publisher to the recorder.

    Args:
        folder: of the new bag.
        scenario: the world; the bag holds it.
        seeds: of the missions.
        about: further metadata.
        leave_out: messages that are missing, topic and step.
        steps: after which a mission stops without an end; None: flown to its end.
        extra: messages at the end, topic, type and content, a second apart.
    """
    metadata = {"scenario": scenario.name, "scenario_values": json.dumps(msgspec.to_builtins(scenario))}
    with BagWriter(folder, metadata | (about or {})) as bag:
        for name in ("pose", "users", "rates", "mission", "move", "diagnostics"):
            bag.add_topic(f"/{name}", topics.TOPICS[name].type)
        now_ns = START_NS
        for mission, seed in enumerate(seeds):
            for state, link, action in states(scenario, seed, steps):
                now_ns += 10_000_000
                for topic, data in step_messages(scenario, mission, seed, state, link, action):
                    if (topic, int(state.step)) not in leave_out:
                        bag.write(f"/{topic}", data, log_time_ns=now_ns + LATENCY_NS, publish_time_ns=now_ns)
        for topic, kind, data in extra:
            now_ns += 10**9
            if topic.removeprefix("/") not in topics.TOPICS:
                bag.add_topic(topic, kind)
            bag.write(topic, data, log_time_ns=now_ns + LATENCY_NS, publish_time_ns=now_ns)
    return folder


def step_messages(
    scenario: Scenario, mission: int, seed: int, state: Any, link: Any, action: int
) -> Iterator[tuple[str, bytes]]:
    """Messages of a step, topic and content."""
    step = int(state.step)
    stamp_ns = scenario.time_ns(mission, step)
    _, _, landed = world.end_of_mission(scenario, state.step, state.cell, state.energy_used_j)
    over = messages.Phase.LANDED if landed else messages.Phase.TIMEOUT
    by_topic: dict[str, messages.Payload] = {
        "users": payloads.users(scenario, state.users_m, mission=mission, step=step, time_ns=stamp_ns),
        "rates": payloads.rates(link, state.data_bits, state.collected, mission=mission, step=step),
        "mission": messages.Mission(
            mission=mission,
            step=step,
            phase=over if step == scenario.mission.max_steps else messages.Phase.READY,
            cell=tuple(map(int, state.cell)),
            remaining_steps=scenario.mission.max_steps - step,
            **payloads.battery(scenario, state.energy_used_j),
            seed=seed,
            scenario=scenario.name,
            fingerprint=scenario.fingerprint,
        ),
    }
    if action >= 0:
        by_topic["move"] = messages.Move(mission=mission, step=step, action=ACTION_LABELS[action])
    yield "pose", pose(stamp_ns, scenario.grid.centre_m(state.cell, like=state.users_m))
    for topic, payload in by_topic.items():
        yield topic, cdr.encode_string(messages.encode(payload))


def unpacked(page: Path) -> dict[str, Any]:
    """The data in a page, by name, as a browser gets it; without Plotly."""
    found = re.findall(r'<script type="text/plain" id="([\w-]+)">([^<]*)</script>', page.read_text("utf-8"))
    return {
        name: json.loads(gzip.decompress(base64.b64decode(data))) for name, data in found if name != "plotly"
    }

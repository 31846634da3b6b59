"""Bags of missions, made without nodes, and copies with changes."""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import msgspec
import numpy as np
from rosbags.rosbag2.metadata import parse_qos

from tests.support.bags import QOS, TYPES
from uav_dc_ros import __version__, cdr, messages, payloads, topics
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.core import world
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.propagation.counter_random import seed_of
from uav_dc_ros.core.propagation.stochastic import Seeds
from uav_dc_ros.core.scenario import Scenario

BEGUN_NS = 1_700_000_000 * 10**9
APART_NS = 10_000  # one message after the other


def pose(position_m: Sequence[float], stamp_ns: int, frame: str = "map") -> bytes:
    """A geometry_msgs/PoseStamped, serialised by rosbags."""
    types, (x, y, z) = TYPES.types, (float(one) for one in position_m)
    stamp = types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    made = types[topics.POSE](
        types["std_msgs/msg/Header"](stamp, frame),
        types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](x, y, z),
            types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        ),
    )
    return bytes(TYPES.serialize_cdr(made, topics.POSE))


def bag_message(topic: str, payload: messages.Payload | bytes, time_ns: int) -> BagMessage:
    """A message that was received when it was published; bytes are a pose."""
    data = payload if isinstance(payload, bytes) else cdr.encode_string(messages.encode(payload))
    return BagMessage(f"/{topic}", topics.TOPICS[topic].type, data, time_ns, time_ns)


def flight(
    scenario: Scenario,
    *,
    act: Callable[[int, int], int] = lambda mission, step: (mission + 3 * step) % 7,
    seed: int = 0,
    missions: int = 1,
    begun_ns: int = BEGUN_NS,
    steps: int | None = None,
) -> list[BagMessage]:
    """What the nodes publish in a lockstep flight: pose, users, mission, rates and move of each step.

    Args:
        scenario: the world.
        act: the action of a step of a mission.
        seed: of mission 0.
        missions: how many.
        begun_ns: when.
        steps: after which the last mission is aborted.
    """
    recorded: list[BagMessage] = []

    def publish(topic: str, payload: messages.Payload | bytes) -> None:
        recorded.append(bag_message(topic, payload, begun_ns + APART_NS * len(recorded)))

    max_steps = scenario.mission.max_steps
    for mission in range(missions):
        rng = np.random.default_rng(seed + mission)
        draws = rng.random(scenario.draws_shape)
        state, first = world.initial(scenario, draws), int(seed_of(draws))
        phase, link = messages.Phase.READY, None
        while True:
            step = int(state.step)
            time_ns = scenario.time_ns(mission, step)
            uav_m = scenario.grid.centre_m(state.cell, like=state.users_m)
            at = {"mission": mission, "step": step}
            seeds = Seeds(first, int(seed_of(draws)))
            users = payloads.users(scenario, state.users_m, time_ns=time_ns, seeds=seeds, **at)
            if link is None:
                drawn = payloads.realization(users, scenario)
                link = world.measure(scenario, uav_m, state.users_m, state.collected, drawn=drawn)
            publish("pose", pose(uav_m.tolist(), time_ns))
            publish("users", users)
            status = messages.Mission(
                **at,
                phase=phase,
                cell=tuple(state.cell.tolist()),
                remaining_steps=max_steps - step,
                **payloads.battery(scenario, state.energy_used_j),
                seed=seed + mission,
                scenario=scenario.name,
                fingerprint=scenario.fingerprint,
            )
            publish("mission", status)
            publish("rates", payloads.rates(link, state.data_bits, state.collected, **at))
            if phase.is_over:
                break
            if mission == missions - 1 and step == steps:
                publish("mission", msgspec.structs.replace(status, phase=messages.Phase.ABORTED))
                break
            action = act(mission, step)
            publish("move", messages.Move(**at, action=ACTION_LABELS[action]))
            draws = rng.random(scenario.draws_shape)
            state, outcome = world.step(scenario, state, np.asarray(action), draws)
            link = outcome.link
            if outcome.terminated or outcome.truncated:
                phase = messages.Phase.LANDED if outcome.landed else messages.Phase.TIMEOUT
    return recorded


def about(scenario: Scenario, seed: int = 0, **values: str) -> dict[str, str]:
    """What the recorder writes about a bag."""
    return {
        "version": __version__,
        "scenario": scenario.name,
        "scenario_fingerprint": scenario.fingerprint,
        "scenario_values": json.dumps(msgspec.to_builtins(scenario)),
        "seed": str(seed),
        "pace": "lockstep",
        **values,
    }


def write(
    folder: Path,
    recorded: Iterable[BagMessage],
    about: dict[str, str] | None = None,
    namespace: str = "",
    latched: bool = False,
) -> Path:
    """A bag with messages, in their order; its folder. `latched`: topics have the durability of the table."""
    with BagWriter(folder, about or {}) as writer:
        known = set()
        for message in recorded:
            topic = namespace + message.topic
            if topic not in known:
                row = topics.TOPICS.get(message.topic.removeprefix("/"))
                held = row is not None and row.latched
                offered = parse_qos(QOS.replace("volatile", "transient_local") if held else QOS)
                writer.add_topic(topic, message.type, offered if latched else ())
                known.add(topic)
            writer.write(
                topic,
                message.data,
                log_time_ns=message.log_time_ns,
                publish_time_ns=message.publish_time_ns,
            )
    return folder


Change = Callable[[BagMessage], BagMessage | None]


def copy(bag: Path, folder: Path, change: Change) -> Path:
    """A copy of a bag, with every message as `change` makes it; None leaves it out."""
    with BagReader(bag) as reader:
        kept = (made for message in reader.messages() if (made := change(message)) is not None)
        return write(folder, kept, reader.about)


def changing(
    topic: str, mission: int, step: int, change: Callable[[messages.Stepped], messages.Stepped | None]
) -> Change:
    """Changes the payload of one step on a topic; None leaves it out."""

    def apply(message: BagMessage) -> BagMessage | None:
        if message.topic != f"/{topic}":
            return message
        payload = messages.decode(cdr.decode_string(message.data), messages.PAYLOADS[topic])
        if (payload.mission, payload.step) != (mission, step):
            return message
        made = change(payload)
        return None if made is None else message._replace(data=bag_message(topic, made, 0).data)

    return apply


def nudged(column: str, user: int) -> Callable[[messages.Stepped], messages.Stepped]:
    """Changes one number of a column in its last bit."""

    def apply(payload: messages.Stepped) -> messages.Stepped:
        values = list(getattr(payload, column))
        values[user] = float(np.nextafter(values[user], np.inf))
        return msgspec.structs.replace(payload, **{column: values})

    return apply

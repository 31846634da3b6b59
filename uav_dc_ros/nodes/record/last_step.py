"""What the last step of a simulated mission consists of, and which of its messages have not arrived.

Over a bad network the last message of a topic may arrive seconds after those of the other topics.
"""

from collections.abc import Mapping

import msgspec

from uav_dc_ros import cdr
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Phase
from uav_dc_ros.topics import POSE, TOPICS

Step = tuple[int, int]  # mission and step


class _Header(msgspec.Struct):
    """The fields of a payload without its long columns."""

    mission: int
    step: int
    run: str = ""
    phase: Phase | None = None


class LastStep:
    """Compares the newest messages of the topics, serialised; `missing` decodes them.

    Args:
        scenario: of the mission.
        newest: the newest message of each topic of the table; its owner sets them.
        missions: that are flown one after another.
        lockstep: whether every step that was flown had a move; at a pace the vehicle may have hovered.
    """

    def __init__(
        self, scenario: Scenario, newest: Mapping[str, bytes], *, missions: int, lockstep: bool
    ) -> None:
        self._scenario, self._newest, self._missions, self._lockstep = scenario, newest, missions, lockstep
        self._decoded: dict[str, tuple[bytes, _Header | int | None]] = {}

    def missing(self) -> dict[str, Step]:
        """The message that each topic lacks.

        A mission that is over has `users`, `rates`, `pose` and `target` of the step of its last `mission`,
        and in lockstep the `move` of the step before. `users` or `rates` of a later step show that `mission`
        itself is missing. Only a topic that was received before can lack a message: of the others nothing
        was published, they are not recorded, or the recorder was restarted after their last message. Before
        the last mission is over, the nodes were stopped, and one of them perhaps before it published.
        """
        mission = self._header("mission")
        if mission is None:
            return {}
        reached: dict[str, Step] = {"mission": (mission.mission, mission.step)}
        for topic in ("users", "rates", "move"):
            header = self._header(topic)
            if header is not None and header.run == mission.run:
                reached[topic] = header.mission, header.step
        last = max(reached[topic] for topic in ("mission", "users", "rates") if topic in reached)
        if last[0] + 1 < self._missions:
            return {}
        if reached["mission"] < last:
            return {"mission": last}
        if mission.phase is None or not mission.phase.is_over:
            return {}
        expected: dict[str, Step] = {"users": last, "rates": last}
        if self._lockstep and mission.step > 0:
            expected["move"] = mission.mission, mission.step - 1
        missing = {topic: step for topic, step in expected.items() if reached.get(topic, step) < step}
        time_ns = self._scenario.time_ns(*last)
        for topic in ("pose", "target"):
            stamp_ns = self._content(topic)
            if isinstance(stamp_ns, int) and stamp_ns < time_ns:
                missing[topic] = last
        return missing

    def _header(self, topic: str) -> _Header | None:
        content = self._content(topic)
        return content if isinstance(content, _Header) else None

    def _content(self, topic: str) -> _Header | int | None:
        """Header or stamp of the newest message; None: there is no message, or it is invalid."""
        data = self._newest.get(topic)
        if data is None:
            return None
        before, content = self._decoded.get(topic, (None, None))
        if before is not data:
            content = _decode(topic, data)
            self._decoded[topic] = data, content
        return content


def _decode(topic: str, data: bytes) -> _Header | int | None:
    try:
        if TOPICS[topic].type == POSE:
            return cdr.Pose(data).stamp_ns
        return msgspec.json.decode(cdr.decode_string(data), type=_Header)
    except (MessageError, msgspec.DecodeError, RecursionError, UnicodeError):
        return None

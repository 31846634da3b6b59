"""The fake autopilot's fence points, by MAVLink's mission protocol (type fence)."""

from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

FENCE = mav.MAV_MISSION_TYPE_FENCE
Point = tuple[int, int, int, float]  # command, latitude and longitude times 1e7, parameter 1


class FenceStore:
    """Stores fence points as ArduCopter does: the whole list at once, when its last item has come.

    It requests an item again after a second without it, and takes none that it did not request.

    Attributes:
        points: those in force.
        result: MAV_MISSION_RESULT of an upload; not 0: it is refused.
        is_silent: it answers nothing.
        uploads: how often a client began one.
    """

    def __init__(self, emit: Callable[..., None]) -> None:
        self.points: list[Point] = []
        self.result, self.is_silent, self.uploads = mav.MAV_MISSION_ACCEPTED, False, 0
        self._emit = emit
        self._new: list[Point] = []
        self._expected = 0

    def repeat(self, out: mav.MAVLink) -> None:
        """Request the item that has not come yet once more."""
        if len(self._new) < self._expected and not self.is_silent:
            out.mission_request_int_send(255, 191, len(self._new), FENCE)

    def receive(self, message: Any, out: mav.MAVLink) -> None:
        """Answer a message of a client, which is the only one."""
        kind = message.get_type()
        if self.is_silent or getattr(message, "mission_type", None) != FENCE:
            return
        client = message.get_srcSystem(), message.get_srcComponent()
        if kind == "MISSION_REQUEST_LIST":
            out.mission_count_send(*client, len(self.points), FENCE)
        elif kind == "MISSION_REQUEST_INT":
            command, x, y, param = self.points[message.seq]
            out.mission_item_int_send(
                *(*client, message.seq, 0, command, 0, 1, param, 0.0, 0.0, 0.0, x, y, 0.0, FENCE)
            )
        elif kind == "MISSION_COUNT":
            self.uploads += 1
            self._new, self._expected = [], message.count
            if self.result != mav.MAV_MISSION_ACCEPTED:
                out.mission_ack_send(*client, self.result, FENCE)
            else:
                out.mission_request_int_send(*client, 0, FENCE)
        elif kind == "MISSION_ITEM_INT" and message.seq != len(self._new):
            out.mission_ack_send(*client, mav.MAV_MISSION_INVALID_SEQUENCE, FENCE)
        elif kind == "MISSION_ITEM_INT" and len(self._new) < self._expected:
            self._new.append((message.command, message.x, message.y, message.param1))
            if len(self._new) < self._expected:
                out.mission_request_int_send(*client, len(self._new), FENCE)
            else:
                self.points = self._new
                out.mission_ack_send(*client, mav.MAV_MISSION_ACCEPTED, FENCE)
                self._emit("fence", points=self.points)

"""Upload of a polygon as the autopilot's fence, by MAVLink's mission protocol. No input or output.

The bridge reads the autopilot's fence first. It uploads the polygon only where there is none, and reads it
back. It replaces no other fence: that is a person's.
"""

import math
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import Any

from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mavlink.systems import AUTOPILOT, COMPONENT, SYSTEM

FENCE = 1  # MAV_MISSION_TYPE
GLOBAL = 0  # MAV_FRAME; the altitude of a vertex has no meaning
VERTEX = 5001  # MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
ACCEPTED, CANCELLED = 0, 15  # MAV_MISSION_RESULT
INVALID_SEQUENCE = 13  # ArduPilot's answer to an item that came twice
RETRY_S, TRIES_MAX = 1.5, 5  # of a request without an answer
SILENCE_S = 8.0  # of an autopilot that requests items, and repeats its requests
SAME = 1  # units in the last place: autopilots convert the numbers


class UploadState(StrEnum):
    """Progress of an upload."""

    READING = "reading the autopilot's fence"
    WRITING = "uploading the fence"
    CHECKING = "reading the fence back"
    DONE = "the autopilot has the fence"
    REFUSED = "the fence is refused"


class FenceUpload:
    """One upload: of a polygon's corners, in the grid's ENU frame."""

    def __init__(self, corners: Sequence[Enu]) -> None:
        self.corners = corners
        self.refusal: str | None = None  # why the autopilot does not have this fence; None: not refused
        self._vertices: list[tuple[int, int]] = []  # latitude and longitude, degrees times 1e7
        self._encode: Callable[[Any, int], Any] | None = None  # the last message, to send it again
        self._sent_s, self._tries, self._tries_max = -math.inf, 0, 0
        self.begin()

    def begin(self) -> None:
        """Start over, on a new link."""
        self.state = UploadState.READING
        self._expected = 0  # items of the autopilot's fence
        self._received: list[tuple[int, int, int, float]] = []  # command, latitude, longitude, parameter 1
        self._send(lambda mav, system: mav.mission_request_list_encode(system, AUTOPILOT, FENCE))

    @property
    def is_over(self) -> bool:
        """Whether the autopilot has the fence, or has refused it."""
        return self.state in (UploadState.DONE, UploadState.REFUSED)

    def due(self, mav: Any, system: int, datum: Geodetic, now_s: float) -> Any:
        """The message to send at a steady time, encoded by pymavlink's `mav`; None: none.

        `datum` is the position of the grid's corner, `system` the vehicle's number.
        """
        if not self._vertices:
            points = map(datum.at, self.corners)
            self._vertices = [(round(p.latitude_deg * 1e7), round(p.longitude_deg * 1e7)) for p in points]
        if self._encode is None or now_s - self._sent_s < (RETRY_S if self._tries_max > 1 else SILENCE_S):
            return None
        if self._tries == self._tries_max:
            if self._tries_max == 1:  # the answer to the last item may be lost
                self._check()
            else:
                self._end(f"the autopilot gave no answer: {self.state}")
            return None
        message = self._encode(mav, system)
        self._sent_s, self._tries = now_s, self._tries + 1
        if self.is_over:  # the end of a download, which has no answer
            self._encode = None
        return message

    def on_message(self, message: Any, codec: Any) -> None:
        """Process a message of the vehicle; `codec` is pymavlink's module."""
        target = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if target != (SYSTEM, COMPONENT) or message.mission_type != FENCE or self.is_over:
            return
        match message.get_type():
            case "MISSION_COUNT" if self.state is not UploadState.WRITING:
                self._on_count(message.count)
            case "MISSION_ITEM_INT" if message.seq == len(self._received) < self._expected:
                self._received.append((message.command, message.x, message.y, message.param1))
                self._request_next()
            case "MISSION_REQUEST_INT" | "MISSION_REQUEST" if self.state is UploadState.WRITING:
                self._send_item(message.seq)
            case "MISSION_ACK" if message.type == INVALID_SEQUENCE:
                pass
            case "MISSION_ACK" if message.type != ACCEPTED:
                results = codec.enums["MAV_MISSION_RESULT"]
                result = results[message.type].name if message.type in results else str(message.type)
                text = result.removeprefix("MAV_MISSION_").lower().replace("_", " ")
                self._end(f"the autopilot refused it: {text}")
            case "MISSION_ACK" if self.state is UploadState.WRITING:
                self._check()

    def _check(self) -> None:
        """Read the fence back."""
        self.begin()
        self.state = UploadState.CHECKING

    def _send(self, encode: Callable[[Any, int], Any] | None, tries_max: int = TRIES_MAX) -> None:
        """Send a message, with retries, until the next one replaces it."""
        self._encode, self._sent_s, self._tries, self._tries_max = encode, -math.inf, 0, tries_max

    def _end(self, refusal: str | None, encode: Callable[[Any, int], Any] | None = None) -> None:
        self.state, self.refusal = UploadState.REFUSED if refusal else UploadState.DONE, refusal
        self._send(encode)

    def _on_count(self, count: int) -> None:
        self._expected, n = count, len(self._vertices)
        if count == 0 and self.state is UploadState.READING:
            self.state = UploadState.WRITING
            self._send(lambda mav, system: mav.mission_count_encode(system, AUTOPILOT, n, FENCE))
        elif count != n:
            self._compare()
        else:
            self._request_next()

    def _request_next(self) -> None:
        seq = len(self._received)
        if seq == self._expected:
            self._compare()
            return
        self._send(lambda mav, system: mav.mission_request_int_encode(system, AUTOPILOT, seq, FENCE))

    def _send_item(self, seq: int) -> None:
        if seq >= len(self._vertices):
            return
        fields = GLOBAL, VERTEX, 0, 1, float(len(self._vertices)), 0.0, 0.0, 0.0, *self._vertices[seq], 0.0
        self._send(lambda mav, system: mav.mission_item_int_encode(system, AUTOPILOT, seq, *fields, FENCE), 1)

    def _compare(self) -> None:
        """End the download: compare what was received with the polygon."""
        n = len(self._vertices)
        expected = [(VERTEX, latitude, longitude, n) for latitude, longitude in self._vertices]
        same = len(self._received) == n and all(
            abs(ours - theirs) <= SAME
            for pair in zip(self._received, expected, strict=True)
            for ours, theirs in zip(*pair, strict=True)
        )
        refusal = None
        if not same and self.state is UploadState.READING:
            refusal = (
                f"the autopilot has another one, of {self._expected} points; expected none, or the same: "
                "remove it in the ground station"
            )
        elif not same:
            refusal = f"the autopilot has stored another one, of {self._expected} points"
        result = ACCEPTED if same else CANCELLED
        self._end(refusal, lambda mav, system: mav.mission_ack_encode(system, AUTOPILOT, result, FENCE))

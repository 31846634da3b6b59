"""What stands between received messages and a bag: it passes them on, pauses, or keeps the last seconds."""

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from uav_dc_ros import cdr, messages
from uav_dc_ros.errors import MessageError, NodeError
from uav_dc_ros.messages import Mission, Phase
from uav_dc_ros.topics import MARK

if TYPE_CHECKING:
    from uav_dc_ros.bags.write import BagWriter

KEPT_BYTES_MAX = 512 * 2**20  # of the messages in memory; older ones go


class ReceivedMessage(NamedTuple):
    """A serialised message; times are nanoseconds since the epoch."""

    topic: str
    data: bytes
    log_time_ns: int
    publish_time_ns: int


class RecordingGate:
    """Passes messages on to the writer of a bag.

    With `keep_last_s` above 0 it keeps the messages of that time in memory. A fault that holds the vehicle of
    a mission, the mission's abort, and `save` write them, and what arrives within the same time after that.
    Each time a part of the bag begins, with the last messages of each latched topic.
    """

    def __init__(self, writer: "BagWriter", keep_last_s: float = 0.0) -> None:
        self.is_paused = False
        self.omitted = 0  # messages that were received and are not in the bag
        self._writer = writer
        self._keep_ns = round(keep_last_s * 1e9)
        self._kept: deque[ReceivedMessage] = deque()
        self._kept_bytes = 0
        self._latched: dict[str, deque[ReceivedMessage]] = {}  # last messages before `_kept`, not in the bag
        self._newest_ns, self._passes_until_ns = 0, -1  # log times
        self._faults: dict[str, tuple[object, ...]] = {}  # present one, by topic `mission`
        self._saves = self._pauses = 0
        self._paused_ns = 0

    @property
    def kept(self) -> int:
        """Messages in memory."""
        return len(self._kept)

    def write(self, topic: str, data: bytes, *, log_time_ns: int, publish_time_ns: int) -> None:
        """Pass a message on, or keep it; arguments as those of `BagWriter.write`."""
        if not (self._keep_ns or self.is_paused):
            self._writer.write(topic, data, log_time_ns=log_time_ns, publish_time_ns=publish_time_ns)
            return
        self._newest_ns = max(self._newest_ns, log_time_ns)
        message = ReceivedMessage(topic, data, log_time_ns, publish_time_ns)
        name = topic.rpartition("/")[2]
        if self.is_paused and name != MARK:
            self._omit(message)
        elif not self._keep_ns or log_time_ns < self._passes_until_ns:
            self._pass(message)
        else:
            self._keep(message)
        if self._keep_ns and not self.is_paused and name == "mission":
            self._check_fault(message)

    def save(self, reason: str) -> int:
        """Write what is kept, and what arrives from now on within `keep_last_s`; the number of messages.

        Raises NodeError without `keep_last_s`.
        """
        if not self._keep_ns:
            raise NodeError("no messages are kept in memory; expected a recorder with keep_last_s above 0")
        first_ns = self._kept[0].log_time_ns if self._kept else self._newest_ns
        written = [one._replace(log_time_ns=first_ns) for topic in self._latched.values() for one in topic]
        self.omitted -= len(written)
        written += self._kept
        self._writer.split()
        for message in written:
            self._pass(message)
        self._kept.clear()
        self._latched.clear()
        self._kept_bytes, self._passes_until_ns = 0, self._newest_ns + self._keep_ns
        self._saves += 1
        self._writer.add_about({f"saved_{self._saves}": f"{self._newest_ns}: {reason}"})
        self._writer.sync()
        return len(written)

    def pause(self, now_ns: int) -> None:
        """Record nothing but marks from now on; NodeError: it is paused already."""
        if self.is_paused:
            raise NodeError("recording is paused already")
        self.is_paused, self._paused_ns = True, now_ns

    def resume(self, now_ns: int) -> None:
        """Go on, first with the last messages of latched topics; NodeError: it is not paused."""
        if not self.is_paused:
            raise NodeError("recording is not paused")
        self.is_paused = False
        self._pauses += 1
        self._writer.add_about({f"paused_{self._pauses}": f"{self._paused_ns} to {now_ns}"})
        if not self._keep_ns:
            missed = [one for topic in self._latched.values() for one in topic]
            self._latched.clear()
            self.omitted -= len(missed)
            for message in sorted(missed, key=lambda one: one.log_time_ns):
                self._pass(message)

    def _pass(self, message: ReceivedMessage) -> None:
        topic, data, log_time_ns, publish_time_ns = message
        self._writer.write(topic, data, log_time_ns=log_time_ns, publish_time_ns=publish_time_ns)

    def _keep(self, message: ReceivedMessage) -> None:
        self._kept.append(message)
        self._kept_bytes += len(message.data)
        oldest_ns = self._newest_ns - self._keep_ns
        while self._kept and (self._kept[0].log_time_ns < oldest_ns or self._kept_bytes > KEPT_BYTES_MAX):
            old = self._kept.popleft()
            self._kept_bytes -= len(old.data)
            self._omit(old)

    def _omit(self, message: ReceivedMessage) -> None:
        """Leave a message out; of a latched topic the last ones are written later."""
        self.omitted += 1
        if depth := self._writer.latched_depth(message.topic):
            before = self._latched.get(message.topic, ())
            self._latched[message.topic] = deque((*before, message), maxlen=depth)

    def _check_fault(self, message: ReceivedMessage) -> None:
        """Save at the beginning of a fault, and of an abort."""
        try:
            status = messages.decode(cdr.decode_string(message.data), Mission)
        except MessageError:  # another topic of this name
            return
        is_aborted = status.phase is Phase.ABORTED
        if not (status.held or is_aborted):
            self._faults.pop(message.topic, None)
            return
        fault = status.run, status.mission, status.fault, is_aborted
        if self._faults.get(message.topic) != fault:
            self._faults[message.topic] = fault
            self.save(f"{message.topic} {status.state}: {status.reason}")

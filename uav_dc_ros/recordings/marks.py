"""Marks: annotations of a person in a recording, each a std_msgs/String on the topic `mark`."""

from dataclasses import dataclass

from uav_dc_ros import cdr
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import one_line
from uav_dc_ros.topics import JSON, MARK

MARKS_MAX = 1000  # read of a bag


@dataclass(frozen=True, kw_only=True)
class Mark:
    """An annotation."""

    s: float  # receipt, seconds after the bag's first message
    namespace: str  # without a slash at its end
    text: str  # one line


def read_marks(reader: BagReader, namespace: str | None = None) -> list[Mark]:
    """The first `MARKS_MAX` marks of a namespace, or of all (None), by time; unreadable ones are left out."""
    wanted = [
        topic.name
        for topic in reader.topics.values()
        if topic.type == JSON
        and topic.name.endswith(f"/{MARK}")
        and namespace in (None, topic.name.removesuffix(f"/{MARK}"))
    ]
    found: list[Mark] = []
    for message in reader.messages(wanted) if wanted else ():
        try:
            text = one_line(cdr.decode_string(message.data).decode(errors="replace"))
        except MessageError:
            continue
        at_s = (message.log_time_ns - reader.first_ns) / 1e9
        found.append(Mark(s=at_s, namespace=message.topic.removesuffix(f"/{MARK}"), text=text))
        if len(found) == MARKS_MAX:
            break
    return found

"""Up to which step a bag was recorded."""

from contextlib import suppress
from pathlib import Path

from uav_dc_ros import cdr, messages
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.errors import MessageError


def last_recorded(bag: Path, namespace: str) -> str:
    """The last step whose `mission` is in the bag, in words. Raises BagError if the bag cannot be read."""
    last = "the start"
    if not bag.is_dir():
        return last
    with BagReader(bag) as reader:
        for message in reader.messages([f"{namespace.rstrip('/')}/mission"]):
            with suppress(MessageError):
                status = messages.decode(cdr.decode_string(message.data), messages.Mission)
                last = f"step {status.step} of mission {status.mission}"
    return last

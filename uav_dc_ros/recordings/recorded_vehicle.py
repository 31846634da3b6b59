"""Which vehicle flew the missions of a bag: our own world's, or a real one."""

from uav_dc_ros import cdr, messages
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Mission, Phase
from uav_dc_ros.topics import SIMULATED

EXTERNAL = "external"  # a real one, of which is not known how it was reached


def vehicle(reader: BagReader, namespace: str) -> str:
    """What flew: `simulated`, or how a real one was reached (`mavlink`, `mavros`, `px4`), or `external`.

    Our recorder tells it. In a bag of another one, a vehicle that says more than which step it is ready for,
    or gives a reason, is a real one. A bag that tells nothing is of the simulated one, as all once were.

    Args:
        reader: of the bag.
        namespace: as `steps.namespace` gives it.
    """
    told = reader.about.get("vehicle")
    if told is not None:
        return told
    for message in reader.messages([f"{namespace}/mission"]):
        try:
            status = messages.decode(cdr.decode_string(message.data), Mission)
        except MessageError:
            continue
        simulated = not status.reason and (status.phase is Phase.READY or status.phase.is_over)
        return SIMULATED if simulated else EXTERNAL
    return SIMULATED


def is_real(reader: BagReader, namespace: str) -> bool:
    """Whether a real vehicle flew, not one of our own world."""
    return vehicle(reader, namespace) != SIMULATED

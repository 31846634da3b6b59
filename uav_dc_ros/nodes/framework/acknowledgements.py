"""Waiting for acknowledgements, before a publisher drops messages that a subscriber has not received.

A publisher keeps a limited number of messages for subscribers that are slow or lose packets. A mission in
lockstep publishes faster than lost packets are sent again, and does not wait for the recorder.
"""

import time
from collections.abc import Callable, Sequence

from rclpy.duration import Duration
from rclpy.publisher import Publisher

ACKNOWLEDGE_S = 1.0  # after so long a message is acknowledged, or its subscriber may have been killed
UNACKNOWLEDGED_S = 0.02  # longest wait while a subscriber does not acknowledge


class AcknowledgementWindow:
    """Waits once half of what the publishers keep may be unacknowledged.

    Args:
        publishers: Reliable publishers that publish one message each with every step.
        clock_s: The time in seconds.
    """

    def __init__(
        self, publishers: Sequence[Publisher], clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._publishers, self._clock_s = publishers, clock_s
        self._steps_max = min(publisher.qos_profile.depth for publisher in publishers) // 2
        self._all_acknowledged = True  # at the last wait
        self._restart()

    def _restart(self) -> None:
        self._steps, self._began_s = 0, self._clock_s()

    def step(self) -> None:
        """Count the messages of one step; wait if the window is full.

        A slow window needs no wait: its messages are older than `ACKNOWLEDGE_S`, except for the newest.
        """
        self._steps += 1
        if self._steps <= self._steps_max:
            return
        age_s = self._clock_s() - self._began_s
        if age_s < ACKNOWLEDGE_S:
            deadline_s = self._clock_s() + (ACKNOWLEDGE_S if self._all_acknowledged else UNACKNOWLEDGED_S)
            self._all_acknowledged = all(
                publisher.wait_for_all_acked(Duration(seconds=max(0.0, deadline_s - self._clock_s())))
                for publisher in self._publishers
            )
        self._restart()

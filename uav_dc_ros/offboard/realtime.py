"""Real-time priority of a thread, so that setpoints keep their rate on a busy computer."""

import os
import sys


def use_realtime_priority() -> bool:
    """Set the calling thread to SCHED_RR at the lowest real-time priority; whether the system permits it.

    On a busy computer an ordinary thread runs tens of milliseconds late. The permission is CAP_SYS_NICE or
    RLIMIT_RTPRIO of 1 or more (systemd: `LimitRTPRIO=1`). Child threads and processes have normal priority.
    """
    if sys.platform != "linux":
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except OSError:
        return False
    return True

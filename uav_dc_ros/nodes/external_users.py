"""The world around a vehicle from outside: users who walk one step with each step that the vehicle tells.

The bridge says in `mission` which step it has come to. The users of that step are published with the time of
the next pose, so that the monitor measures them from where the vehicle was then.
"""

from uav_dc_ros import messages, payloads
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users import WalkingUsers
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Phase

ARRIVED = (Phase.READY, Phase.LANDING, Phase.LANDED, Phase.TIMEOUT, Phase.ABORTED)


class ExternalUsers:
    """Says which users are to be published, and when. It needs no journal: seed and step tell all.

    Args:
        scenario: the world.
        seed: of mission 0.

    Attributes:
        status: what the vehicle said last; None before it said anything.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._scenario, self._seed = scenario, seed
        self.status: messages.Mission | None = None
        self._crowd: WalkingUsers | None = None
        self._crowd_of = -1  # mission
        self._is_due = False

    def hear(self, payload: messages.Mission) -> None:
        """Note where the vehicle's mission stands. A step that is told again is answered again.

        Raises:
            MessageError: a mission in another world, or with other users.
        """
        payloads.check(payload, self._scenario)
        seed = self._seed + payload.mission
        if payload.seed != seed:
            raise MessageError(
                "seed",
                f"mission {payload.mission} has seed {payload.seed}; expected {seed}: start this node with "
                "the mission's seed",
            )
        self.status = payload
        told = (self._crowd_of, self._crowd.step) if self._crowd else (-1, -1)
        is_new = (payload.mission, payload.step) != told
        if payload.phase is Phase.READY or (payload.phase in ARRIVED and is_new and payload.step > 0):
            self._is_due = True

    def users(self, stamp_ns: int, run: str = "") -> messages.Users | None:
        """The users to be published with the time of a pose, nanoseconds; None: nobody waits for any."""
        if not self._is_due or self.status is None:
            return None
        self._is_due = False
        mission, step = self.status.mission, self.status.step
        if self._crowd is None or self._crowd_of != mission or self._crowd.step > step:
            self._crowd, self._crowd_of = WalkingUsers(self._scenario, self._seed + mission), mission
        self._crowd.walk(step - self._crowd.step)
        return payloads.users(
            self._scenario, self._crowd.positions_m, mission=mission, step=step, time_ns=stamp_ns, run=run
        )

"""The users around an external vehicle, beside a bridge."""

from uav_dc_ros import messages, payloads
from uav_dc_ros.core.mobility import WalkingUsers
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Phase

# Phases in which an external vehicle has reached its step.
REACHED = (Phase.READY, Phase.LANDING, Phase.LANDED, Phase.TIMEOUT, Phase.ABORTED)


class ExternalUsers:
    """The users around an external vehicle: they walk one step with each step of its mission.

    The bridge publishes in `mission` which step it has reached. The users of that step have the time of the
    next pose, so that the monitor measures them from the vehicle's position at that time.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._scenario, self._seed = scenario, seed
        self.status: messages.Mission | None = None  # the last payload of `mission`
        self._users: WalkingUsers | None = None
        self._mission = -1  # of these users
        self._is_due = False

    def update(self, payload: messages.Mission) -> None:
        """Follow the mission; raises MessageError for a mission in another world, or with other users."""
        payloads.check(payload, self._scenario)
        seed = self._seed + payload.mission
        if payload.seed != seed:
            raise MessageError(
                "seed",
                f"mission {payload.mission} has seed {payload.seed}; expected {seed}: start this node with "
                "the mission's seed",
            )
        self.status = payload
        last = (self._mission, self._users.step) if self._users else (-1, -1)
        is_new = payload.step > 0 and (payload.mission, payload.step) != last
        if payload.phase is Phase.READY or (payload.phase in REACHED and is_new):
            self._is_due = True  # after a repeated `ready` again

    def users(self, stamp_ns: int, run: str = "") -> messages.Users | None:
        """The users to publish with the time of a pose, nanoseconds; None: none are due."""
        if not self._is_due or self.status is None:
            return None
        self._is_due = False
        mission, step = self.status.mission, self.status.step
        if self._users is None or self._mission != mission or self._users.step > step:
            self._users, self._mission = WalkingUsers(self._scenario, self._seed + mission), mission
        self._users.walk(step - self._users.step)
        return payloads.users(
            self._scenario,
            self._users.positions_m,
            mission=mission,
            step=step,
            time_ns=stamp_ns,
            run=run,
            seeds=self._users.seeds,
        )

"""What the page shows of one mission, in bounded memory: its steps, the flown path, phases and faults."""

import base64
from collections import deque
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, Raw

from uav_dc_ros.core import radio
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Mission, Phase, Rates, Users
from uav_dc_ros.phases import POLICY_CONTROLLED
from uav_dc_ros.recordings.pages.page import world_data
from uav_dc_ros.recordings.thinning import EveryNth, SpacedSeries, spread

STEPS_MAX = 400  # of a mission that the slider reaches; a longer mission is thinned
VALUES_MAX = 600_000  # steps times users: 6 MB
USERS_MAX = 10_000  # drawn
EVENTS_MAX = 200  # the newest phases and faults
PATH_MAX = 1000  # points
PATH_CELLS = 0.05  # between two points of the path, in cells of the grid ...
PATH_M = 1.0  # ... or metres, where the grid is not known
WAITING, SERVED, COLLECTED = "012"  # state of a user
# The phases of a simulated vehicle; any other one is a real vehicle's, whose pose is not its cell's centre.
SIMULATED_PHASES = (Phase.READY, Phase.LANDED, Phase.TIMEOUT, Phase.ABORTED)

Xyz = tuple[float, float, float]


class MissionHistory:
    """One mission of one vehicle. All times are seconds since its first message, by this computer's clock.

    Args:
        key: Number of the mission among all that the page shows.
        namespace: Its ROS namespace.
        first: Its first state.
        scenario: Its world; None: not known here, so that only what the messages hold is drawn.
    """

    def __init__(self, key: int, namespace: str, first: Mission, scenario: Scenario | None) -> None:
        self.key, self.namespace, self.scenario = key, namespace, scenario
        self.version = 0  # changes with everything
        self.is_real = False  # whether a real vehicle flies it
        self.status = first  # the newest
        self.stride = 1
        self.events: deque[tuple[int, Raw]] = deque(maxlen=EVENTS_MAX)  # with their numbers, from 1
        self.path: SpacedSeries[Xyz] = SpacedSeries(PATH_MAX)
        self._steps: EveryNth[tuple[int, Raw]] | None = None
        self._last_step: tuple[int, Raw] | None = None
        self._shown: Any = None  # indices of the users drawn
        self._position_m: Xyz | None = None
        self._charge: float | None = None  # as a real vehicle reports it
        self._event: tuple[str, str] | None = None  # state and reason
        self._is_routine = False
        self._n_events = 0

    def head(self) -> dict[str, Any]:
        """What stays the same: identity and world."""
        first = self.status
        return {
            "namespace": self.namespace,
            "run": first.run,
            "mission": first.mission,
            "seed": first.seed,
            "scenario": first.scenario,
            "world": None if self.scenario is None else world_data(self.scenario),
            "users_max": USERS_MAX,
        }

    @property
    def steps(self) -> list[tuple[int, Raw]]:
        """Numbers of the steps kept, and the steps, encoded; the newest one is always among them."""
        kept, last = [] if self._steps is None else self._steps.kept, self._last_step
        return kept if last is None or (kept and kept[-1][0] == last[0]) else [*kept, last]

    def now(self) -> dict[str, Any]:
        """The newest state."""
        status = self.status
        return {
            "uav_m": _rounded(self._position_m),
            "charge": self._charge_of(status),
            "step": status.step,
            "phase": status.phase.value,
            "state": status.state,
            "reason": status.reason,
            "held": status.held,
            "remaining_steps": status.remaining_steps,
            "over": status.phase.is_over,
        }

    def add_status(self, status: Mission, at_s: float) -> None:
        """Add a state of the vehicle."""
        self.version += 1
        self.is_real |= status.phase not in SIMULATED_PHASES
        self.status = status
        event = (status.state, status.reason)
        routine = status.phase in POLICY_CONTROLLED and not status.held
        if event != self._event and not (routine and self._is_routine):
            self._n_events += 1
            row = {"n": self._n_events, "s": round(at_s, 2), "step": status.step, "state": status.state}
            row |= {"reason": status.reason, "held": status.held, "fault": status.fault}
            self.events.append((self._n_events, Raw(msgspec.json.encode(row))))
        self._event, self._is_routine = event, routine

    def add_pose(self, position_m: Xyz) -> None:
        """Add a position of the vehicle; a point of the path, if it is far enough from the last one."""
        self.version += 1
        self._position_m = position_m
        spacing_m = PATH_M if self.scenario is None else PATH_CELLS * self.scenario.grid.cell_m
        last = self.path.kept[-1] if self.path.kept else None
        if last is None or np.linalg.norm(np.subtract(position_m, last)) >= spacing_m * self.path.factor:
            self.path.add(position_m)

    def set_charge(self, charge: float) -> None:
        """Set the charge of a real vehicle's battery, 0 to 1."""
        self.version += 1
        self._charge = charge

    def add_step(self, rates: Rates, users: Users | None, status: Mission | None, at_s: float) -> None:
        """Add a step: its rates, and its users and state, if they were received; not a step from before."""
        if self._last_step is not None and rates.step <= self._last_step[0]:
            return
        self.version += 1
        n_users = len(rates.collected)
        if self._shown is None or len(self._shown) != min(n_users, USERS_MAX):
            self._shown = spread(n_users, USERS_MAX)
            self._steps = EveryNth(max(min(STEPS_MAX, VALUES_MAX // len(self._shown)), 20))
        assert self._steps is not None, "it is set with the users"
        shown = self._shown
        if self.scenario is not None and status is not None and not self.is_real:
            east_m, north_m, up_m = self.scenario.grid.centre_m(
                np.asarray(status.cell), like=np.zeros(1)
            ).tolist()
            self.add_pose((east_m, north_m, up_m))
        collected, served = np.asarray(rates.collected), np.asarray(rates.served)
        state = np.where(collected, COLLECTED, np.where(served, SERVED, WAITING))[shown]
        step = {
            "step": rates.step,
            "s": round(at_s, 2),
            "uav_m": _rounded(self._position_m),
            "reach_m": round(self._reach_m(), 1),
            "users": None if users is None else _packed([users.x_m, users.y_m], shown),
            "state": "".join(state.tolist()),
            "n_users": n_users,
            "n_collected": int(collected.sum()),
            "sum_rate_bps": rates.sum_rate_bps,
            "charge": self._charge_of(status),
            "phase": None if status is None else status.state,
        }
        self._last_step = rates.step, Raw(msgspec.json.encode(step))
        self._steps.add(rates.step, self._last_step)
        self.stride = self._steps.stride

    def _charge_of(self, status: Mission | None) -> float | None:
        """Charge that the vehicle reports, or else that of the scenario's model, 0 to 1; None: not known."""
        if self._charge is not None or status is None or status.state_of_charge is UNSET:
            return self._charge
        return status.state_of_charge

    def _reach_m(self) -> float:
        """Radius on the ground within which users are served, metres; 0: not known."""
        if self.scenario is None or self._position_m is None:
            return 0.0
        return float(radio.ground_reach_m(self.scenario.mission.d_cons_m, max(self._position_m[2], 0.0)))


def is_routine(text: bytes) -> bool:
    """Whether an encoded `mission` is one of many in a step without faults; false where unclear."""
    return b'"held":true' not in text and (b'"phase":"ready"' in text or b'"phase":"moving"' in text)


def _packed(columns: list[list[float]], shown: Any) -> str:
    """Columns of numbers as 32-bit floats, little endian, one column after another, in base64."""
    return base64.b64encode(np.asarray(columns, "<f4")[:, shown].tobytes()).decode()


def _rounded(position_m: Xyz | None) -> list[float] | None:
    return None if position_m is None else [round(value, 2) for value in position_m]

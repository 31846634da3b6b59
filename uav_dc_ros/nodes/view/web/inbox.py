"""Messages of one namespace on their way to the page: few are decoded, however many come."""

import re
import time
from collections.abc import Callable

import msgspec

from uav_dc_ros import cdr, messages, payloads
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Mission, Rates, Users
from uav_dc_ros.nodes.view.web.feed import Feed
from uav_dc_ros.nodes.view.web.mission_history import MissionHistory, is_routine

VALUES_MAX = 2000  # steps times users that one update decodes; at least one step
PENDING_MAX = 2000  # steps that wait for their other messages ...
PENDING_BYTES = 64 * 2**20  # ... and their bytes: a dead channel monitor leaves users without rates

Step = tuple[str, int, int]  # run, mission and step
# As this package's nodes begin a payload: the header of another one takes a decoder.
BEGIN = re.compile(rb'\{"run":"([0-9a-f]{16})","mission":(\d{1,9}),"step":(\d{1,9})[,}]')


class _Header(msgspec.Struct):
    """The fields of a payload without its long columns."""

    mission: int
    step: int
    run: str = ""


class Inbox:
    """Collects the messages of a namespace, and adds some of their steps to the feed.

    Args:
        namespace: As the page names it.
        feed: Where the missions are shown.
        find_scenario: The scenario of a mission's name and fingerprint; None: not known here.
        clock_s: The time in seconds.
    """

    def __init__(
        self,
        namespace: str,
        feed: Feed,
        find_scenario: Callable[[str, str], Scenario | None],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.namespace = namespace
        self._feed, self._find_scenario, self._clock_s = feed, find_scenario, clock_s
        self._pending: dict[Step, dict[str, tuple[bytes, float]]] = {}  # messages by topic, with their times
        self._pending_bytes = 0
        self._statuses: list[tuple[bytes, float]] = []  # that are decoded with the next update
        self._newest: MissionHistory | None = None
        self._began_s: dict[int, float] = {}  # by key of the mission
        self.has_new = False

    @property
    def needs_pose(self) -> bool:
        """Whether the cell does not give the position: with a real vehicle, or in an unknown world."""
        return self._newest is not None and (self._newest.is_real or self._newest.scenario is None)

    def add(self, topic: str, data: bytes) -> None:
        """Add a serialized message of `users`, `rates` or `mission`; raises MessageError for no such one."""
        text = cdr.decode_string(data)
        now_s, step = self._clock_s(), _step(text)
        self._keep(step, topic, text, now_s)
        if topic == "mission":
            if self._statuses and is_routine(self._statuses[-1][0]):
                self._statuses.pop()  # only the newest one of many is shown
            self._statuses.append((text, now_s))
        while len(self._pending) > PENDING_MAX or self._pending_bytes > PENDING_BYTES:
            self._drop(next(iter(self._pending)))
        del self._statuses[:-PENDING_MAX]
        self.has_new = True

    def add_pose(self, position_m: tuple[float, float, float]) -> None:
        """Add a position of the vehicle."""
        if self._newest is not None:
            self._newest.add_pose(position_m)
            self.has_new = True

    def set_charge(self, charge: float) -> None:
        """Set the charge that the vehicle reports, 0 to 1."""
        if self._newest is not None:
            self._newest.set_charge(charge)
            self.has_new = True

    def update(self, reject: Callable[[str, MessageError], None]) -> None:
        """Add what has come to the feed; `reject` takes the topic and error of each invalid message."""
        self.has_new = False
        statuses, self._statuses = self._statuses, []
        for text, at_s in statuses:
            self._add_status(text, at_s, reject)
        complete = [step for step, topics in self._pending.items() if "rates" in topics and self._find(step)]
        for step in _sampled(complete, self._steps_max()):
            self._add_step(step, reject)
        for step in complete:
            self._drop(step)

    def _keep(self, step: Step, topic: str, text: bytes, now_s: float) -> None:
        topics = self._pending.setdefault(step, {})
        self._pending_bytes += len(text) - (len(topics[topic][0]) if topic in topics else 0)
        topics[topic] = text, now_s

    def _drop(self, step: Step) -> None:
        self._pending_bytes -= sum(len(text) for text, _ in self._pending.pop(step).values())

    def _find(self, step: Step) -> MissionHistory | None:
        run, mission, _ = step
        return self._feed.find(self.namespace, run, mission)

    def _steps_max(self) -> int:
        sizes = [len(topics["rates"][0]) for topics in self._pending.values() if "rates" in topics]
        users = max(sizes, default=0) // 60 + 1  # a user takes about so many bytes
        return max(1, VALUES_MAX // users)

    def _add_status(self, text: bytes, at_s: float, reject: Callable[[str, MessageError], None]) -> None:
        try:
            status = messages.decode(text, Mission)
            history = self._feed.find(self.namespace, status.run, status.mission)
            if history is None:
                scenario = self._find_scenario(status.scenario, status.fingerprint)
                history = self._feed.begin(self.namespace, status, scenario)
                self._began_s[history.key] = at_s
            if history.scenario is not None:
                payloads.check(status, history.scenario)
            history.add_status(status, at_s - self._began_s[history.key])
            self._newest = history
        except MessageError as error:
            reject("mission", error)

    def _add_step(self, step: Step, reject: Callable[[str, MessageError], None]) -> None:
        history, texts = self._find(step), self._pending[step]
        assert history is not None, "a step of a mission that the page shows"
        found: dict[str, messages.Payload] = {}
        for topic in ("rates", "users", "mission"):
            if topic not in texts:
                continue
            try:
                payload = messages.decode(texts[topic][0], messages.PAYLOADS[topic])
                if history.scenario is not None:
                    payloads.check(payload, history.scenario)
            except MessageError as error:
                reject(topic, error)
            else:
                found[topic] = payload
        rates, users, status = found.get("rates"), found.get("users"), found.get("mission")
        if isinstance(rates, Rates):
            at_s = texts["rates"][1] - self._began_s[history.key]
            same = isinstance(users, Users) and len(users.x_m) == len(rates.collected)
            history.add_step(
                rates,
                users if isinstance(users, Users) and same else None,
                status if isinstance(status, Mission) else None,
                at_s,
            )


def _step(text: bytes) -> Step:
    """Run, mission and step of a payload, whose other fields may be invalid; MessageError: it has none."""
    if (begin := BEGIN.match(text)) is not None:
        return begin[1].decode(), int(begin[2]), int(begin[3])
    try:
        header = msgspec.json.decode(text, type=_Header)
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise MessageError("malformed", messages.one_line(str(error))) from None
    return header.run, header.mission, header.step


def _sampled(steps: list[Step], maximum: int) -> list[Step]:
    """At most `maximum` steps, evenly spaced, and the last one of each mission."""
    stride = -(-len(steps) // maximum)
    last = {(run, mission): i for i, (run, mission, _) in enumerate(steps)}
    from_end = len(steps) - 1
    return [step for i, step in enumerate(steps) if (from_end - i) % stride == 0 or last[step[:2]] == i]

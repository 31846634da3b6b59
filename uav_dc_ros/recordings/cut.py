"""The verb `cut`: a new bag with the messages of a time, or of some missions or steps.

The latched messages that held at its start are repeated at its head. A cut that begins with a mission leaves
out those of the mission's own topics: the mission publishes all of them anew.
"""

import argparse
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

from uav_dc_ros import cdr, cli
from uav_dc_ros.bags.edit.copy import add_output, copying, merged_about, output
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.errors import BagError, MessageError, ParameterError, UavDcError
from uav_dc_ros.messages import PAYLOADS
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.recorded_step import RecordedStep
from uav_dc_ros.recordings.step_reader import STEP_TOPICS, Steps
from uav_dc_ros.topics import TOPICS

_SECONDS = cli.number(0.0, 2.0**31, "seconds, of at least 0")


class _Key(msgspec.Struct):
    """Mission and step of a payload; other fields are ignored."""

    mission: int
    step: int


def _range(text: str) -> range:
    """The type of an option that is a whole number, or a range of them with its end."""
    found = re.fullmatch(r"([0-9]{1,9})(?:-([0-9]{1,9}))?", text)
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (0, -1)
    if last < first:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a whole number, or two such as 3-5")
    return range(first, last + 1)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    add("--start", type=_SECONDS, metavar="S", help="seconds from the bag's beginning (default: 0)")
    add("--end", type=_SECONDS, metavar="S", help="seconds from the bag's beginning (default: to its end)")
    add("--missions", type=_range, metavar="N[-M]", help="whole missions instead of a time")
    add("--steps", type=_range, metavar="N[-M]", help="steps of one mission (default: --missions 0)")
    what = "run in the bag whose missions are meant, from 0 (default: %(default)d)"
    add("--flight", type=cli.whole_number(0), default=0, metavar="N", help=what)
    add("--namespace", metavar="NAME", help="of the missions, for a bag with several")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Write the new bag; the exit status."""
    by_time = options.start is not None or options.end is not None
    by_mission = options.missions is not None or options.steps is not None
    if by_time == by_mission:
        given = "both a time and missions" if by_time else "neither a time nor missions"
        raise ParameterError(f"{given}; expected --start, --end or both, or --missions, --steps or both")
    if options.steps is not None and options.missions is not None and len(options.missions) > 1:
        raise ParameterError("--steps of several missions; expected --missions with one")
    with BagReader(options.bag, repeats=False) as reader:
        if by_time:
            _cut_time(reader, options)
        else:
            _cut_missions(reader, options)
    return 0


def _cut_time(reader: BagReader, options: argparse.Namespace) -> None:
    start_s, end_s = options.start or 0.0, options.end
    length_s = (reader.last_ns - reader.first_ns) / 1e9
    if start_s > length_s or (end_s is not None and end_s <= start_s):
        end = "" if end_s is None else f" --end {end_s:g}"
        raise ParameterError(
            f"--start {start_s:g}{end}: no message; expected a time within the bag's {length_s:.3f} s"
        )
    start_ns = reader.first_ns + round(start_s * 1e9)
    end_ns = None if end_s is None else reader.first_ns + round(end_s * 1e9)
    about = merged_about([reader])
    about.pop("missions", None)
    text = f"{start_s:g} s to {'the end' if end_s is None else f'{end_s:g} s'}"
    with copying([reader], output(options), about=about, made_by=f"bag cut, {text},") as copy:
        copy.hold(reader.held(start_ns))
        copy.write(reader.recorded(start_ns=start_ns, end_ns=end_ns))


@dataclass(kw_only=True)
class _Selection:
    """Missions, or steps of one, and the log times of their messages."""

    missions: range
    steps: range | None
    start_ns: int = 2**63
    last_ns: int = 0
    end_ns: int | None = None  # first message after them; None: to the end of the bag

    def has(self, mission: int, step: int) -> bool:
        """Whether a step is selected."""
        return mission in self.missions and (self.steps is None or step in self.steps)

    def messages(self, reader: BagReader, namespace: str) -> Iterator[BagMessage]:
        """Messages of the selection: payloads by their mission and step, all others by time."""
        payloads = {f"{namespace}/{name}" for name in STEP_TOPICS if name in PAYLOADS}
        key = msgspec.json.Decoder(_Key)
        end_ns = None if self.end_ns is None else max(self.end_ns, self.last_ns + 1)
        for message in reader.recorded(start_ns=self.start_ns, end_ns=end_ns):
            if message.topic in payloads:
                try:
                    found = key.decode(cdr.decode_string(message.data))
                    if not self.has(found.mission, found.step):
                        continue
                except (MessageError, msgspec.DecodeError, RecursionError, UnicodeError):
                    pass  # no payload: by time
            yield message


def _cut_missions(reader: BagReader, options: argparse.Namespace) -> None:
    namespace = step_reader.namespace(reader, options.namespace)
    if reader.set_back_ns:
        raise BagError(
            f"bag {reader.path}: its clock was set back by {reader.set_back_ns / 1e9:.3f} s; expected log "
            "times that increase, or a cut by --start and --end"
        )
    selection = _Selection(missions=options.missions or range(1), steps=options.steps)
    _find(reader, namespace, selection, options.flight)
    about = merged_about([reader])
    about.pop("missions", None)
    text = _named("mission", selection.missions)
    if selection.steps is None:
        about["missions"] = str(len(selection.missions))
    else:
        text += f", {_named('step', selection.steps)}"
    held = reader.held(selection.start_ns)
    if selection.steps is None or selection.steps[0] == 0:
        own = {f"{namespace}/{name}" for name in TOPICS}
        held = (message for message in held if message.topic not in own)
    with copying([reader], output(options), about=about, made_by=f"bag cut, {text},") as copy:
        copy.hold(held)
        copy.write(selection.messages(reader, namespace))


def _named(what: str, numbers: range) -> str:
    return f"{what} {numbers[0]}" if len(numbers) == 1 else f"{what}s {numbers[0]} to {numbers[-1]}"


def _find(reader: BagReader, namespace: str, selection: _Selection, flight: int) -> None:
    """Find the times of a selection; raises BagError if the bag does not hold its first and last step."""
    try:
        step_ns = step_reader.scenario(reader, namespace).step_ns
    except UavDcError:
        step_ns = 2**63  # unknown scenario, in a bag of another recorder
    seen: list[tuple[int, int]] = []  # first and last mission and step of the flight
    first = last = None
    for step in Steps(reader, namespace, step_ns):
        if step.flight != flight:
            continue
        key = step.mission, step.step
        seen = [*seen[:1], key]
        if selection.has(*key):
            first, last = first or key, key
            times_ns = _times_ns(step)
            selection.start_ns = min(selection.start_ns, *times_ns)
            selection.last_ns = max(selection.last_ns, *times_ns)
        elif last is not None:
            selection.end_ns = min(_times_ns(step))
            break
    wanted = _named("mission", selection.missions)
    ends = None if first is None or last is None else (first[0], last[0])
    expected = (selection.missions[0], selection.missions[-1])
    if selection.steps is not None:
        wanted += f", {_named('step', selection.steps)}"
        ends = None if first is None or last is None else (first[1], last[1])
        expected = (selection.steps[0], selection.steps[-1])
    if ends != expected:
        held = " to ".join(f"mission {mission}, step {step}" for mission, step in dict.fromkeys(seen))
        raise BagError(f"bag {reader.path}: no {wanted} in flight {flight}; it holds {held or 'none'}")


def _times_ns(step: RecordedStep) -> list[int]:
    """Log times of a step's messages."""
    return [*step.log_ns.values(), *(report.log_ns for report in step.phase_reports)]

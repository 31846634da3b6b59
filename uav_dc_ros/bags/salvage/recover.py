"""Recover a torn or damaged bag: copy what can be read of it into a new, whole bag.

The source is not changed; its recorder may have been killed or still write it, or it may be damaged anywhere.
The report lists what was lost: how many bytes, where, and between which messages.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from uav_dc_ros import files
from uav_dc_ros.bags.metadata import ABOUT_RECORD, LOST_BYTES_KEY, Part, merged, write_metadata
from uav_dc_ros.bags.part_writer import PartWriter
from uav_dc_ros.bags.salvage.repair import copy
from uav_dc_ros.bags.salvage.scan import Damage, Scan, has_end
from uav_dc_ros.bags.storage import describe_foreign, storage_files
from uav_dc_ros.bags.unreadable import Unreadable
from uav_dc_ros.errors import BagError

MAX_LISTED = 20  # damaged places of a file


@dataclass(frozen=True, kw_only=True)
class RecoveredPart:
    """The result for one file."""

    source: Path
    part: Part | None = None  # the recovered contents; None: nothing was recovered, for `reason`
    had_end: bool = False  # whether the file had an undamaged end
    expected: int | None = None  # messages of the file by its summary; None without one
    damages: Sequence[Damage] = ()  # unusable places
    unreadable: Unreadable = field(default_factory=Unreadable)  # recovered messages that cannot be decoded
    reason: str = ""

    @property
    def lost_messages(self) -> int | None:
        """Lost messages; None if the number is unknown."""
        if self.expected is not None and self.part is not None:
            return max(0, self.expected - self.part.message_count)
        return None if self.damages else 0


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """A recovered bag."""

    folder: Path
    parts: Sequence[RecoveredPart]  # the result for each file of the source

    @property
    def whole(self) -> Part:
        """All recovered contents."""
        return merged([part.part for part in self.parts if part.part is not None])

    @property
    def lost_bytes(self) -> int:
        """Unusable bytes of the source."""
        return sum(damage.n_bytes for part in self.parts for damage in part.damages)


def recover(path: Path, folder: Path) -> Recovered:
    """Copy what can be read of a bag, or of one MCAP file, into a new one, renamed into place when complete.

    Raises BagError if `folder` exists, there is no bag, nothing of it can be recovered, or the disk is full.
    """
    taken = f"bag folder {folder} exists already; expected a new one"
    if folder.exists() or folder.is_symlink():
        raise BagError(taken)
    sources = storage_files(path)
    recovered: list[RecoveredPart] = []
    parts: list[Part] = []
    try:
        with files.building(folder) as temporary:
            for source in sources:
                recovered.append(_recover_part(source, temporary / f"{folder.name}_{len(parts)}.mcap"))
                parts = [part.part for part in recovered if part.part is not None]
            if not parts:
                reasons = "; ".join(f"{part.source.name}: {part.reason}" for part in recovered)
                raise BagError(f"nothing can be recovered from {path}: {reasons}")
            write_metadata(temporary, parts)
            if folder.exists():  # made in the meantime
                raise BagError(taken)
    except OSError as error:
        raise BagError(f"bag folder {folder} cannot be written: {error.strerror}") from None
    return Recovered(folder=folder, parts=recovered)


def _recover_part(source: Path, path: Path) -> RecoveredPart:
    """Copy what can be read of a file; BagError: unsupported compression, OSError: the disk is full."""
    try:
        file = source.open("rb")
    except OSError as error:
        return RecoveredPart(source=source, reason=f"cannot be read: {error.strerror}")
    with file:
        scan = Scan(source, file)
        if not scan.size:
            return RecoveredPart(source=source, reason="an empty file")
        if not scan.is_mcap():
            return RecoveredPart(source=source, reason=f"no MCAP file: it {describe_foreign(scan.magic)}")
        writer = PartWriter(path)
        try:
            copy(scan, writer)
            if not (scan.part.topics or scan.part.about):
                path.unlink()
                reason = f"{scan.size} bytes without a topic"
                return RecoveredPart(source=source, reason=reason, damages=scan.damages)
            if scan.lost_bytes:
                writer.add_metadata(ABOUT_RECORD, {LOST_BYTES_KEY: str(scan.lost_bytes)})
            writer.finish()
        finally:
            writer.abandon()
        statistics = scan.summary.statistics if scan.summary is not None else None
        return RecoveredPart(
            source=source,
            part=writer.part,
            had_end=has_end(file),
            expected=statistics.message_count if statistics is not None else None,
            damages=scan.damages,
            unreadable=scan.unreadable,
        )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bag recover`."""
    bag = "folder of a bag, or one MCAP file; it is not changed"
    parser.add_argument("bag", type=Path, metavar="BAG", help=bag)
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="folder of the new bag")


def run(options: argparse.Namespace) -> int:
    """Run `bag recover`; returns the exit status."""
    print("\n".join(report(recover(options.bag, options.out))))
    return 0


def report(recovered: Recovered) -> list[str]:
    """Lines on what was recovered and what was lost."""
    whole = recovered.whole
    start_ns = whole.first_ns or 0
    n_parts = sum(part.part is not None for part in recovered.parts)
    duration_s = max(0, whole.last_ns - start_ns) / 1e9
    lines = [
        f"{recovered.folder}: {_count(whole.message_count, 'message')} "
        f"of {_count(len(whole.topics), 'topic')} in {_count(n_parts, 'part')}, {duration_s:.3f} s"
    ]
    for part in recovered.parts:
        if part.part is None:
            lines.append(f"{part.source.name}: nothing was recovered: {part.reason}")
        else:
            state = "whole" if part.had_end and not part.damages else "damaged" if part.had_end else "no end"
            of = f" of {part.expected:,}" if part.lost_messages and part.expected is not None else ""
            lines.append(f"{part.source.name} ({state}): {part.part.message_count:,}{of} messages recovered")
        lines += [f"  {line}" for line in part.unreadable.lines()]
        lines += [f"  lost {_place(damage, start_ns)}" for damage in part.damages[:MAX_LISTED]]
        if len(part.damages) > MAX_LISTED:
            lines.append(f"  and {len(part.damages) - MAX_LISTED:,} places more")
    lost = f"{recovered.lost_bytes:,} bytes" if recovered.lost_bytes else "nothing that had reached the disk"
    unknown = any(part.lost_messages is None for part in recovered.parts)
    n_lost = sum(part.lost_messages or 0 for part in recovered.parts)
    if n_lost or (recovered.lost_bytes and not unknown):
        lost += f", {'at least ' if unknown else ''}{_count(n_lost, 'message')}"
    return [*lines, f"lost: {lost}"]


def _place(damage: Damage, start_ns: int) -> str:
    after = damage.after_ns is not None and f"{(damage.after_ns - start_ns) / 1e9:.3f} s"
    before = damage.before_ns is not None and f"{(damage.before_ns - start_ns) / 1e9:.3f} s"
    if after and before:
        span = f"between {after} and {before}"
    elif after:
        span = f"after {after}"
    elif before:
        span = f"before {before}"
    else:
        span = "without a message around"
    return f"{damage.n_bytes:,} bytes at byte {damage.at:,}, {span}: {damage.reason}"


def _count(n: int, name: str) -> str:
    return f"{n:,} {name}" + ("" if n == 1 else "s")

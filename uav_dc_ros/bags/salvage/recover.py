"""Make a whole bag of what can be read of another one, which is never touched.

The other one may lack its end, since its recorder was killed or still writes it, or be damaged anywhere.
What was lost is told: how many bytes, where, and between which messages.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from uav_dc_ros import files
from uav_dc_ros.bags.metadata import LOST, METADATA_NAME, Part, total, write_metadata
from uav_dc_ros.bags.part_writer import PartWriter
from uav_dc_ros.bags.salvage.repair import copy
from uav_dc_ros.bags.salvage.scan import Damage, Scan, has_end
from uav_dc_ros.bags.storage import foreign, storage_files
from uav_dc_ros.bags.unreadable import Unreadable
from uav_dc_ros.errors import BagError

TOLD_MAX = 20  # damaged places of a file that are told one by one


@dataclass(frozen=True, kw_only=True)
class RecoveredPart:
    """What became of a file.

    Attributes:
        source: the file.
        part: what was recovered of it; None for nothing at all.
        had_end: whether it had an end, unharmed.
        expected: messages that it once held, as its end tells; None without an end.
        damages: what could not be used, as it lies in the file.
        unreadable: messages that were recovered, and cannot be decoded.
        why: why nothing was recovered.
    """

    source: Path
    part: Part | None = None
    had_end: bool = False
    expected: int | None = None
    damages: Sequence[Damage] = ()
    unreadable: Unreadable = field(default_factory=Unreadable)
    why: str = ""

    @property
    def lost_messages(self) -> int | None:
        """Messages that are lost; None if nobody knows how many."""
        if self.expected is not None and self.part is not None:
            return max(0, self.expected - self.part.message_count)
        return None if self.damages else 0


@dataclass(frozen=True, kw_only=True)
class Recovered:
    """A recovered bag: its folder, and what became of each file of the other one."""

    folder: Path
    parts: Sequence[RecoveredPart]

    @property
    def whole(self) -> Part:
        """All that was recovered."""
        return total([part.part for part in self.parts if part.part is not None])

    @property
    def lost_bytes(self) -> int:
        """Bytes that could not be used, as they lie in the files."""
        return sum(damage.n_bytes for part in self.parts for damage in part.damages)


def recover(path: Path, folder: Path) -> Recovered:
    """Copy what can be read of a bag into a new one.

    Args:
        path: the bag's folder, or one of its MCAP files.
        folder: of the new bag; must not exist. It appears at once, when it is whole.

    Raises:
        BagError: `folder` exists, there is no bag, nothing of it can be recovered, or the disk is full.
    """
    if folder.exists() or folder.is_symlink():
        raise BagError(f"bag folder {folder} exists already; expected a new one")
    sources = storage_files(path)
    recovered: list[RecoveredPart] = []
    try:
        with files.building(folder) as temporary:
            for source in sources:
                number = sum(part.part is not None for part in recovered)
                recovered.append(_recover_part(source, temporary / f"{folder.name}_{number}.mcap"))
            parts = [part.part for part in recovered if part.part is not None]
            if not parts:
                told = "; ".join(f"{part.source.name}: {part.why}" for part in recovered)
                raise BagError(f"nothing can be recovered from {path}: {told}")
            write_metadata(temporary, parts)
            if folder.exists():  # made in the meantime
                raise BagError(f"bag folder {folder} exists already; expected a new one")
    except OSError as error:
        raise BagError(f"bag folder {folder} cannot be written: {error.strerror}") from None
    return Recovered(folder=folder, parts=recovered)


def _recover_part(source: Path, path: Path) -> RecoveredPart:
    """Copy what can be read of a file.

    Raises:
        BagError: it is compressed in a way that cannot be read here.
        OSError: the disk is full.
    """
    try:
        file = source.open("rb")
    except OSError as error:
        return RecoveredPart(source=source, why=f"cannot be read: {error.strerror}")
    with file:
        scan = Scan(source, file)
        if not scan.size:
            return RecoveredPart(source=source, why="an empty file")
        if not scan.is_mcap():
            return RecoveredPart(source=source, why=f"no MCAP file: it {foreign(scan.magic)}")
        writer = PartWriter(path)
        try:
            copy(scan, writer)
            if not (scan.part.topics or scan.part.about):
                path.unlink()
                return RecoveredPart(
                    source=source, why=f"{scan.size} bytes without a topic", damages=scan.damages
                )
            if scan.lost_bytes:
                writer.add_metadata(METADATA_NAME, {LOST: str(scan.lost_bytes)})
            writer.finish()
        finally:
            writer.abandon()
        summary = scan.summary
        statistics = summary.statistics if summary is not None else None
        return RecoveredPart(
            source=source,
            part=writer.part,
            had_end=has_end(file),
            expected=statistics.message_count if statistics is not None else None,
            damages=scan.damages,
            unreadable=scan.unreadable,
        )


def add_options(parser: argparse.ArgumentParser) -> None:
    """What the verb takes."""
    parser.add_argument(
        "bag", type=Path, metavar="BAG", help="folder of a bag, or one MCAP file; stays as it is"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="folder of the new bag")


def run(options: argparse.Namespace) -> int:
    """The verb."""
    print("\n".join(told(recover(options.bag, options.out))))
    return 0


def told(recovered: Recovered) -> list[str]:
    """What was recovered and what was lost, as lines."""
    whole = recovered.whole
    start_ns = whole.first_ns or 0
    n_parts = sum(part.part is not None for part in recovered.parts)
    lines = [
        f"{recovered.folder}: {_many(whole.message_count, 'message')} of {_many(len(whole.topics), 'topic')} "
        f"in {_many(n_parts, 'part')}, {max(0, whole.last_ns - start_ns) / 1e9:.3f} s"
    ]
    for part in recovered.parts:
        if part.part is None:
            lines.append(f"{part.source.name}: nothing was recovered: {part.why}")
        else:
            state = "whole" if part.had_end and not part.damages else "damaged" if part.had_end else "no end"
            of = f" of {part.expected:,}" if part.lost_messages and part.expected is not None else ""
            lines.append(f"{part.source.name} ({state}): {part.part.message_count:,}{of} messages recovered")
        lines += [f"  {line}" for line in part.unreadable.lines()]
        lines += [f"  lost {_lost(damage, start_ns)}" for damage in part.damages[:TOLD_MAX]]
        if len(part.damages) > TOLD_MAX:
            lines.append(f"  and {len(part.damages) - TOLD_MAX:,} places more")
    lost = f"{recovered.lost_bytes:,} bytes" if recovered.lost_bytes else "nothing that had reached the disk"
    unknown = any(part.lost_messages is None for part in recovered.parts)
    n_lost = sum(part.lost_messages or 0 for part in recovered.parts)
    if n_lost or (recovered.lost_bytes and not unknown):
        lost += f", {'at least ' if unknown else ''}{_many(n_lost, 'message')}"
    return [*lines, f"lost: {lost}"]


def _lost(damage: Damage, start_ns: int) -> str:
    after = None if damage.after_ns is None else f"{(damage.after_ns - start_ns) / 1e9:.3f} s"
    before = None if damage.before_ns is None else f"{(damage.before_ns - start_ns) / 1e9:.3f} s"
    match after, before:
        case None, None:
            span = "without a message around"
        case None, _:
            span = f"before {before}"
        case _, None:
            span = f"after {after}"
        case _:
            span = f"between {after} and {before}"
    return f"{damage.n_bytes:,} bytes at byte {damage.at:,}, {span}: {damage.why}"


def _many(n: int, name: str) -> str:
    return f"{n:,} {name}" + ("" if n == 1 else "s")

"""Write a rosbag2 folder: one MCAP file with zstd chunks, and metadata.yaml.

Messages are stored as they came, serialised; nothing is decoded. The MCAP file tells the whole story
by itself, so a folder whose metadata.yaml was never written loses nothing but convenience.
"""

import contextlib
import os
import time
from collections.abc import Iterable, Mapping
from io import StringIO
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from uav_dc_ros import __version__
from uav_dc_ros.errors import BagError

METADATA_NAME = "uav_dc_ros"  # of our record inside the MCAP file
CHUNK_BYTES = 128 * 1024  # small: a chunk that was not finished is what a killed recorder loses


class BagWriter:
    """A bag that is being written; a context manager that closes it.

    Args:
        folder: the bag's folder; must not exist.
        about: what the bag is about, stored inside as text by key.

    Raises:
        BagError: the folder exists, or cannot be made.
    """

    def __init__(self, folder: Path, about: Mapping[str, str]) -> None:
        self.folder = folder
        self._about = dict(about)
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._topics: list[dict[str, Any]] = []
        self._counts: dict[str, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        if folder.exists():
            raise BagError(f"bag folder {folder} exists already; expected a new one")
        try:
            folder.mkdir(parents=True)
            self._file = (folder / f"{folder.name}_0.mcap").open("xb")
        except OSError as error:
            raise BagError(f"bag folder {folder} cannot be made: {error.strerror}") from None
        self._mcap = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._mcap.start(profile="ros2", library=f"uav_dc_ros {__version__}")
        self._mcap.add_metadata(METADATA_NAME, self._about)
        self._file.flush()

    @property
    def message_count(self) -> int:
        """Messages written so far."""
        return sum(self._counts.values())

    def add_topic(self, name: str, type: str, offered_qos: Iterable[Qos] = ()) -> None:
        """Announce a topic, once, before its first message.

        Args:
            name: full name, with its namespace.
            type: ROS 2 message type, such as `std_msgs/msg/String`.
            offered_qos: QoS that the topic's publishers offer.
        """
        if type not in self._schemas:
            definition, _ = self._typestore.generate_msgdef(type, ros_version=2)
            self._schemas[type] = self._mcap.register_schema(type, "ros2msg", definition.encode())
        qos = dump_qos_v9(list(offered_qos))
        digest = self._typestore.hash_rihs01(type)
        self._channels[name] = self._mcap.register_channel(
            name,
            "cdr",
            self._schemas[type],
            {"offered_qos_profiles": _yaml(qos), "topic_type_hash": digest},
        )
        self._counts[name] = 0
        self._topics.append(
            {
                "name": name,
                "type": type,
                "serialization_format": "cdr",
                "offered_qos_profiles": qos,
                "type_description_hash": digest,
            }
        )

    def write(self, topic: str, data: bytes, *, log_time_ns: int, publish_time_ns: int) -> None:
        """Append a message.

        Args:
            topic: full name of a topic that was added.
            data: the message, serialised (CDR).
            log_time_ns: when it was received, nanoseconds since the epoch.
            publish_time_ns: when it was published.

        Raises:
            BagError: the disk is full, or gone.
        """
        self._counts[topic] += 1
        try:
            self._mcap.add_message(
                self._channels[topic],
                log_time_ns,
                data,
                publish_time_ns,
                sequence=self._counts[topic],
            )
            self._file.flush()  # a chunk that is finished is out of this process, whatever happens to it
        except OSError as error:
            raise self._failure(error) from None
        self._first_ns = log_time_ns if self._first_ns is None else min(self._first_ns, log_time_ns)
        self._last_ns = max(self._last_ns, log_time_ns)

    def close(self) -> None:
        """Finish the file and write metadata.yaml. Closing twice does nothing.

        Raises:
            BagError: the disk is full, or gone.
        """
        if self._file.closed:
            return
        try:
            self._finish()
        except OSError as error:
            raise self._failure(error) from None

    def _failure(self, error: OSError) -> BagError:
        """Give the file up as it is: what was written until now stays."""
        with contextlib.suppress(OSError):
            self._file.close()
        return BagError(
            f"bag {self.folder} cannot be written any further: {error.strerror}; its MCAP file has no index, "
            "and holds what was written until now"
        )

    def _finish(self) -> None:
        metadata = self._metadata()
        self._mcap.add_metadata("rosbag2", {"serialized_metadata": _yaml(metadata)})
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        temporary = self.folder / ".metadata.yaml"
        temporary.write_text(_yaml({"rosbag2_bagfile_information": metadata}) + "\n", "utf-8")
        temporary.rename(self.folder / "metadata.yaml")

    def __enter__(self) -> Self:
        """Use the writer in a `with` statement."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bag, also when the block failed: what was recorded stays readable."""
        self.close()

    def _metadata(self) -> dict[str, Any]:
        """The content of metadata.yaml, version 9 (Jazzy)."""
        start_ns = time.time_ns() if self._first_ns is None else self._first_ns
        duration_ns = max(0, self._last_ns - start_ns)
        path = Path(self._file.name).name
        times = {
            "duration": {"nanoseconds": duration_ns},
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "message_count": self.message_count,
        }
        return {
            "version": 9,
            "storage_identifier": "mcap",
            **times,
            "topics_with_message_count": [
                {"topic_metadata": topic, "message_count": self._counts[topic["name"]]}
                for topic in self._topics
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [path],
            "files": [{"path": path, **times}],
            "custom_data": self._about,
            "ros_distro": "jazzy",
        }


def _yaml(value: Any) -> str:
    text = StringIO()
    yaml = YAML(typ="safe")
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.representer.ignore_aliases = lambda *_: True
    yaml.dump(value, text)
    return text.getvalue().strip()

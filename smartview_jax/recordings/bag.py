"""Open a bag of ROS 1 or ROS 2 and stream its messages, with errors that name bag and topic.

The format is recognised from the name: a `.bag` file of ROS 1, a folder or `.db3` file of ROS 2, or
an `.mcap` file. The library `rosbags` reads all of them without an installation of ROS.
"""

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from ..extras import import_extra

METADATA_FILE = "metadata.yaml"
"""The file in a bag's folder of ROS 2 that lists its topics."""

SUFFIXES = (".bag", ".db3", ".mcap")
"""Suffixes of the files that hold the messages."""

_PROGRESS_STEPS = 200
"""Number of times that the progress of one pass over a bag is reported."""


class Message(NamedTuple):
    """A message of a bag.

    Attributes:
        received: when it was recorded, ns since 1970.
        content: the message, whose attributes are named as in ROS 2.
    """

    topic: str
    received: int
    content: Any


class Bag:
    """An open bag; `open_bag` opens and closes it.

    Attributes:
        kinds: type of the messages of each topic, such as `sensor_msgs/msg/Image`.
        counts: number of messages of each topic.
    """

    def __init__(self, path: Path, reader: Any):
        self.path = path
        self._reader = reader
        self.kinds: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        for connection in reader.connections:
            self.kinds.setdefault(connection.topic, connection.msgtype)
            count = self.counts.get(connection.topic, 0) + connection.msgcount
            self.counts[connection.topic] = count

    def topics_of(self, kinds: Collection[str]) -> list[str]:
        """Return the topics whose messages are of one of some types, sorted."""
        return sorted(topic for topic, kind in self.kinds.items() if kind in kinds)

    def required(self, topic: str, kinds: Collection[str], purpose: str) -> str:
        """Return a topic's name as the bag has it.

        Args:
            topic: the name; the first slash may be missing.
            kinds: types of messages that are expected.
            purpose: option or argument that names the topic, for messages.

        Raises:
            ValueError: the bag has no such topic, or its messages are of another type.
        """
        present = next((name for name in (topic, f"/{topic}") if name in self.kinds), None)
        if present is None:
            raise ValueError(
                f"{self.path}: {purpose}: no topic {topic}; the bag has {self.listed_topics()}"
            )
        if self.kinds[present] not in kinds:
            raise ValueError(
                f"{self.path}: {purpose}: topic {present} has messages of {self.kinds[present]}; "
                f"expected {' or '.join(kinds)}"
            )
        return present

    def listed_topics(self) -> str:
        """Return all topics with their types as text."""
        if not self.kinds:
            return "no topics"
        return ", ".join(f"{topic} ({self.kinds[topic]})" for topic in sorted(self.kinds))

    def messages(
        self,
        topics: Collection[str],
        stage: str = "reading",
        progress: Callable[[str], None] | None = None,
        until: int | None = None,
    ) -> Iterator[Message]:
        """Read the messages of some topics one after the other, in the order of recording.

        Args:
            topics: names of the topics.
            stage: what is done, for `progress`.
            progress: called with a line of text some hundred times.
            until: time before which messages were recorded, ns; None for all.

        Raises:
            ValueError: the bag is damaged; the message names it, and the topic.
        """
        connections = [part for part in self._reader.connections if part.topic in topics]
        if not connections:
            return
        total = sum(self.counts[topic] for topic in topics)
        step = max(1, total // _PROGRESS_STEPS)
        messages = self._reader.messages(connections=connections, stop=until)
        number = 0
        while True:
            # The library's errors for damaged bags are of many unrelated types.
            try:
                connection, received, raw = next(messages)
            except StopIteration:
                return
            except Exception as error:
                where = f"after {number} of {total} messages"
                raise ValueError(f"{self.path}: damaged {where}: {_words(error)}") from error
            try:
                content = self._reader.deserialize(raw, connection.msgtype)
            except Exception as error:
                raise ValueError(
                    f"{self.path}: topic {connection.topic}: a message is not readable as "
                    f"{connection.msgtype}: {_words(error)}"
                ) from error
            number += 1
            if progress is not None and (number % step == 0 or number == 1):
                progress(f"{stage} {self.path.name}: {number} of {max(number, total)}")
            yield Message(connection.topic, received, content)


@contextmanager
def open_bag(path: str | Path) -> Iterator[Bag]:
    """Open a bag.

    Args:
        path: of a file of ROS 1 (`.bag`) or ROS 2 (`.db3`, `.mcap`), or of the folder of a bag of
            ROS 2, or of a folder with the parts of one bag of ROS 1.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no bag, or a damaged one.
        ImportError: `rosbags` is not installed.
    """
    path = Path(path)
    files = bag_files(path)
    highlevel = import_extra("rosbags.highlevel", "ros", "reading bags of ROS")
    typesys = import_extra("rosbags.typesys", "ros", "reading bags of ROS")
    # Older bags of ROS 2 have no definitions of their messages; ROS's own changed little.
    standard_types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    try:
        reader = highlevel.AnyReader(files, default_typestore=standard_types)
        reader.open()
    except Exception as error:
        raise ValueError(f"{path}: not readable as a bag of ROS: {_words(error)}") from error
    try:
        yield Bag(path, reader)
    finally:
        reader.close()


def bag_files(path: Path) -> list[Path]:
    """Return the files, or the one folder, that make up a bag; none of them is read yet.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a file of another kind, or a folder without a bag.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such bag")
    expected = f"expected a file {', '.join(SUFFIXES)}, or the folder of a bag of ROS 2"
    if path.is_file():
        if path.suffix not in SUFFIXES:
            raise ValueError(f"{path}: {expected}")
        return [path]
    if (path / METADATA_FILE).is_file():
        return [path]
    parts = sorted(path.glob("*.bag"))
    if parts:
        return parts
    # A recorder that was stopped by force has not written its list of topics.
    stored = sorted(part for suffix in SUFFIXES[1:] for part in path.glob(f"*{suffix}"))
    if len(stored) == 1:
        return stored
    hint = f", found {len(stored)} files without {METADATA_FILE}: ros2 bag reindex writes it"
    raise ValueError(f"{path}: {expected}{hint if stored else ''}")


def _words(error: Exception) -> str:
    """Return an error of the library on one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    if "index" in text and "not indexed" in text:
        text += " (rosbag reindex repairs a bag whose recording was interrupted)"
    return text[:300]

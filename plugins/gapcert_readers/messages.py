"""Logs of messages by topic: MCAP and ROS 2 bags. Topics with times of their own meet at those of the first column."""

from __future__ import annotations

import json
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

import gapcert as gc
from gapcert import Array
from gapcert_readers.thresholds import THRESHOLDS

from .files import TIME, Columns, FileReader, told

Message = tuple[str, int, Any]  # topic, time of logging in ns, content
_STEP = re.compile(r"\.?([^.\[\]]+)|\[([^\]]+)\]")
_METADATA = "metadata.yaml"
NAMES = ("name", "names", "joint_names")  # the list beside an array that names its elements


class MessageReader(FileReader):
    """A Recording from messages."""

    units_in_names: ClassVar = False

    def from_file(self, path: Path, title: str) -> Sequence[tuple[str, Columns]]:
        """One trajectory: all columns at the times of the first one's topic."""
        c = self.config
        with told(title, type(self).form):
            topics = sorted(type(self).topics(path), key=len, reverse=True)
            homes = {column: self._topic(title, column, topics) for column in c.columns.values()}
            series = {topic: _Series() for topic in homes.values()}
            for topic, at, content in type(self).messages(path, set(series)):
                series[topic].add(_stamp(content, at) if c.clock == "message" else at, content)
        first = series[homes[next(iter(c.columns.values()))]]
        table: dict[str, Any] = {TIME: np.array(first.times, dtype=np.int64)}
        for channel, column in c.columns.items():
            one = series[homes[column]]
            values = one.column(column[len(homes[column]) :])
            if not np.isfinite(values).any():
                raise gc.UsageError(f"recording: {title}: '{column}' is in no message; there are {', '.join(one.fields())}")
            table[column] = values if one is first else _at(table[TIME], one, values, channel in c.held)
        return [(title, table)]

    @staticmethod
    def _topic(title: str, column: str, topics: Sequence[str]) -> str:
        for topic in topics:
            if column.startswith((f"{topic}.", f"{topic}[")):
                return topic
        known = ", ".join(sorted(topics))
        raise gc.UsageError(f"recording: {title}: no topic for '{column}'; expected /topic.field; there are {known}")

    @classmethod
    def tables(cls, path: Path, title: str | None = None) -> Sequence[tuple[str, Columns]]:
        """One table per topic that has numbers, and one without columns of each that nothing can be read of."""
        series: dict[str, _Series] = {}
        with told(title or path.name, cls.form):
            for topic, at, content in cls.messages(path, None):
                series.setdefault(topic, _Series()).add(at if content is None else _stamp(content, at), content)
        out: list[tuple[str, Columns]] = []
        for topic, one in series.items():
            if one.contents[0] is None:
                out.append((f"{topic}, which cannot be decoded", {}))
            elif fields := one.fields():
                out.append(
                    (topic, {TIME: (np.array(one.times) - one.times[0]) / 1e9, **{topic + f: one.column(f) for f in fields}})
                )
        return out

    @classmethod
    @abstractmethod
    def topics(cls, path: Path) -> Sequence[str]:
        """Those that have messages."""

    @classmethod
    @abstractmethod
    def messages(cls, path: Path, topics: set[str] | None) -> Iterator[Message]:
        """Of some topics, which have to be decoded, or of all, with None for what cannot be."""


@final
class _Series:
    """The messages of one topic."""

    def __init__(self) -> None:
        self.times: list[int] = []
        self.contents: list[Any] = []

    def add(self, at: int, content: Any) -> None:
        self.times.append(at)
        self.contents.append(content)

    def column(self, field: str) -> Array:
        """One number per message; NaN where it has none."""
        steps = [(name or index) for name, index in _STEP.findall(field)]
        return np.array([_number(c, steps) for c in self.contents], dtype=np.float64)

    def fields(self) -> list[str]:
        """Everything in the first message that is a number."""
        return [f for f in _leaves(self.contents[0], "") if not f.startswith(".header.stamp")] if self.contents else []


def _number(content: Any, steps: Sequence[str]) -> float:
    here, beside = content, content
    for step in steps:
        found = _inside(here, beside, step)
        if found is None:
            return np.nan
        here, beside = found, here
    try:
        return float(here)
    except (TypeError, ValueError):
        return np.nan


def _inside(here: Any, beside: Any, step: str) -> Any:
    """A field of a message, or an element of an array, by its index or its name in the list beside it."""
    if isinstance(here, Mapping):
        return here.get(step)
    if not isinstance(here, list | tuple | np.ndarray):
        return getattr(here, step, None)
    if step.isdigit():
        return here[int(step)] if int(step) < len(here) else None
    for key in NAMES:
        names = beside.get(key) if isinstance(beside, Mapping) else getattr(beside, key, None)
        if names is not None and step in list(names):
            index = list(names).index(step)
            return here[index] if index < len(here) else None
    return None


def _leaves(content: Any, path: str) -> Iterator[str]:
    if isinstance(content, bool | int | float | np.number):
        yield path
    elif isinstance(content, list | tuple | np.ndarray):
        for i, part in enumerate(content[: THRESHOLDS.listed_elements]):
            yield from _leaves(part, f"{path}[{i}]")
    else:
        parts = content if isinstance(content, Mapping) else getattr(content, "__dict__", {})
        for name, part in parts.items():
            if not str(name).startswith("_"):
                yield from _leaves(part, f"{path}.{name}")


def _stamp(content: Any, at: int) -> int:
    """Nanoseconds of header.stamp, where there is one that is set; else the time of logging."""
    seconds = [_number(content, ["header", "stamp", n]) for n in ("sec", "secs")]
    rest = [_number(content, ["header", "stamp", n]) for n in ("nanosec", "nsec", "nsecs")]
    whole = next((int(s) for s in seconds if s == s), 0) * 10**9 + next((int(r) for r in rest if r == r), 0)
    return whole or at


def _at(times: Any, one: _Series, values: Array, held: bool) -> Array:
    """Values at other times; NaN before the first and, unless they are held, after the last."""
    own = np.array(one.times, dtype=np.int64)
    order = np.argsort(own, kind="stable")
    own, values = own[order], values[order]
    if held:
        row = np.searchsorted(own, times, side="right") - 1
        return np.asarray(np.where(row >= 0, values[np.maximum(row, 0)], np.nan))
    start = own[0]
    return np.asarray(np.interp((times - start) / 1e9, (own - start) / 1e9, values, left=np.nan, right=np.nan))


@final
class McapReader(MessageReader):
    """Messages of MCAP files: CDR and ROS 1 by the definitions in the file, and JSON."""

    form = "an MCAP file with messages of ROS 2, ROS 1 or JSON"
    suffixes: ClassVar = (".mcap",)

    @classmethod
    def topics(cls, path: Path) -> Sequence[str]:
        """Those of all channels."""
        from mcap.reader import make_reader

        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
            return [c.topic for c in summary.channels.values()] if summary is not None else []

    @classmethod
    def messages(cls, path: Path, topics: set[str] | None) -> Iterator[Message]:
        """In the order of logging."""
        from mcap.reader import make_reader

        decoders: dict[int, Callable[[bytes], Any] | None] = {}
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages(topics=list(topics) if topics else None):
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(channel.message_encoding, schema)
                if (decode := decoders[channel.id]) is None and topics is not None:
                    what = f"is encoded as '{channel.message_encoding}' by '{getattr(schema, 'name', '')}'"
                    raise ValueError(f"topic '{channel.topic}' {what}, which is no message")
                yield channel.topic, message.log_time, decode and decode(message.data)


def _decoder(encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
    if encoding == "json":
        return json.loads
    if encoding not in ("cdr", "ros1") or schema is None or schema.encoding not in ("ros2msg", "ros1msg"):
        return None
    store = get_typestore(Stores.EMPTY)
    name = schema.name if schema.name.count("/") == 2 else schema.name.replace("/", "/msg/", 1)
    try:
        store.register(get_types_from_msg(schema.data.decode(), name))
    except TypesysError:  # a service or an action, say
        return None
    read = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
    return lambda data: read(data, name)


@final
class Rosbag2Reader(MessageReader):
    """Messages of ROS 2 bags, whatever stores them."""

    form = "a ROS 2 bag, a folder with metadata.yaml"
    suffixes: ClassVar = ("", ".db3")

    @classmethod
    def topics(cls, path: Path) -> Sequence[str]:
        """Those of all connections."""
        with _bag(path) as bag:
            return list(bag.topics)

    @classmethod
    def messages(cls, path: Path, topics: set[str] | None) -> Iterator[Message]:
        """In the order of logging."""
        with _bag(path) as bag:
            chosen = [c for c in bag.connections if topics is None or c.topic in topics]
            for connection, at, data in bag.messages(connections=chosen):
                try:
                    content = bag.deserialize(data, connection.msgtype)
                except (KeyError, TypesysError):
                    if topics is not None:
                        what = f"topic '{connection.topic}' has '{connection.msgtype}'"
                        raise ValueError(f"{what}, which the bag does not define") from None
                    content = None
                yield connection.topic, at, content

    @classmethod
    def tables(cls, path: Path, title: str | None = None) -> Sequence[tuple[str, Columns]]:
        """One table per topic; none where the folder is no bag."""
        stored = path.is_file() or any(p.suffix in (".db3", ".mcap") for p in path.iterdir())
        return super().tables(path, title) if stored or (path / _METADATA).is_file() else ()


def _bag(path: Path) -> Any:
    """The bag of a folder, or of a file in it."""
    from rosbags.highlevel import AnyReader

    folder = path if path.is_dir() else path.parent
    if not (folder / _METADATA).is_file():
        what = f"recording: {path.name} cannot be read: there is no {_METADATA} beside what is stored"
        other = "; kind: mcap reads an .mcap file without one" if any(folder.glob("*.mcap")) else ""
        raise gc.UsageError(f"{what}; expected {Rosbag2Reader.form}; `ros2 bag reindex {folder}` writes it{other}")
    # Bags of older distributions do not carry their definitions.
    return AnyReader([folder], default_typestore=get_typestore(Stores.LATEST))

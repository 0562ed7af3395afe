"""The choice of the topics of a recording whose transforms are read, and the prefixes of their frames."""

from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple, TypeAlias

from tfbus.frames import is_frame
from tfbus.recording.formats._raw_transforms import FOXGLOVE_TYPES, TF_TYPES, holds_transforms
from tfbus.recording.formats._storage import Channel

MOVING_TOPIC: Final = "tf"
STATIC_TOPIC: Final = "tf_static"

Topics: TypeAlias = str | Iterable[str] | Mapping[str, str] | None


class Choice(NamedTuple):
    """The way in which a channel is read."""

    static: bool
    prefix: str


class Selection:
    """Decides which channels are read.

    Parameters
    ----------
    topics : str, iterable of str, or mapping of str to str, optional
        Topics, with a prefix for each if it is a mapping. By default ``/tf``, ``/tf_static``, and all topics with
        Foxglove's transforms outside of namespaces.
    prefix : str
        Put before the names of all frames.
    namespaces : bool
        Whether ``tf`` and ``tf_static`` in all namespaces are read, each under the prefix of its namespace.

    Raises
    ------
    ValueError
        If both `topics` and `namespaces` are given, or a prefix begins with a slash.
    TypeError
        If a topic or a prefix is no string.
    """

    def __init__(self, topics: Topics = None, prefix: str = "", namespaces: bool = False) -> None:
        if topics is not None and namespaces:
            raise ValueError("topics and namespaces are two ways to choose: give one of them")
        if isinstance(topics, str):
            topics = (topics,)
        pairs = topics.items() if isinstance(topics, Mapping) else ((topic, "") for topic in topics or ())
        self._prefixes: dict[str, str] | None = None if topics is None else {}
        for topic, its_prefix in pairs:
            if not isinstance(topic, str):
                raise TypeError(f"a topic must be a str, not {topic!r}")
            assert self._prefixes is not None
            self._prefixes[topic.removeprefix("/")] = its_prefix
        self._prefix = prefix
        self._namespaces = namespaces
        for each in (prefix, *(self._prefixes or {}).values()):
            if each != "" and not is_frame(each):
                raise ValueError(f"a prefix must not start with '/', got {each!r}")

    @property
    def topics(self) -> list[str]:
        """The topics that were asked for by their names, without leading slashes."""
        return list(self._prefixes or ())

    def choose(self, channel: Channel) -> Choice | None:
        """The way in which a channel is read; None if it is not."""
        if not holds_transforms(channel):
            return None
        name = channel.topic.removeprefix("/")
        namespace, _, last = name.rpartition("/")
        static = last == STATIC_TOPIC or (last.endswith("_static") and channel.type in TF_TYPES)
        own = last in (MOVING_TOPIC, STATIC_TOPIC)
        if self._prefixes is not None:
            return Choice(static, self._prefix + self._prefixes[name]) if name in self._prefixes else None
        if self._namespaces:
            inner = f"{namespace}/" if namespace else ""
            return Choice(static, self._prefix + inner) if own and not inner.startswith("/") else None
        if name in (MOVING_TOPIC, STATIC_TOPIC) or (channel.type in FOXGLOVE_TYPES and not own):
            return Choice(static, self._prefix)
        return None


def looks_like_transforms(channel: Channel) -> bool:
    """Whether a user may expect transforms on a channel: by its type, or by its name."""
    last = channel.topic.rpartition("/")[2]
    return channel.type in TF_TYPES or channel.type in FOXGLOVE_TYPES or last in (MOVING_TOPIC, STATIC_TOPIC)

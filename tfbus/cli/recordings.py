"""Reading recordings: the options that choose topics, and the tree of a whole recording with warnings of losses."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cyclopts import Group, Parameter

from tfbus.cli.arguments import Flag, UsageError
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import format_counts, progress, warn

with lazy_imports():
    from tfbus.recording.recording import Problems, Recording, SpeedLimit, fill, open_recording
    from tfbus.tree.tree import TransformTree


@Parameter(name="*", group=Group("What to read", sort_key=4))
@dataclass(frozen=True, slots=True)
class TopicOptions:
    """The options of a command that reads a recording.

    Parameters
    ----------
    topic
        Read this topic in place of /tf and /tf_static; with =PREFIX behind it, such as /robot1/tf=robot1/, put a prefix
        before the names of its frames. May be given several times.
    namespaces
        Read tf and tf_static of all namespaces; the frames of /robot1/tf get the prefix robot1/.
    prefix
        A prefix for the names of all frames.
    odometry
        Read this topic of nav_msgs/Odometry as transforms too; with =CHILD behind it, such as /camera/pose=camera, a
        topic of poses. May be given several times.
    invert
        Make the child of the odometry the parent, because it has a parent already.
    """

    topic: tuple[str, ...] = ()
    namespaces: Flag = False
    prefix: str = ""
    odometry: tuple[str, ...] = ()
    invert: Flag = False

    def open(self, file: Path) -> Recording:
        """Open a recording.

        Raises
        ------
        UsageError
            If the options contradict each other.
        RecordingError
            As `open_recording`.
        """
        return open_recording(file, **self.arguments())

    def arguments(self) -> dict[str, Any]:
        """The options as arguments of `open_recording`; raises `UsageError` if they contradict each other."""
        if self.topic and self.namespaces:
            raise UsageError("--topic and --namespaces are two ways to choose: give one of them")
        if self.invert and not self.odometry:
            raise UsageError("--invert is for the topics of --odometry: give one")
        pairs = [topic.partition("=") for topic in self.topic]
        for prefix in (self.prefix, *(prefix for _, _, prefix in pairs)):
            if prefix.startswith("/"):
                raise UsageError(f"a prefix must not start with '/', got {prefix!r}")
        topics = {name: prefix for name, _, prefix in pairs} or None
        odometry = {name: child or None for name, _, child in (each.partition("=") for each in self.odometry)}
        chosen = {"topics": topics, "prefix": self.prefix, "namespaces": self.namespaces}
        return chosen | ({"odometry": odometry, "invert": self.invert} if odometry else {})


DEFAULT_TOPICS = TopicOptions()
"""The options of a command line that gives none."""


def load_tree(
    file: Path, topics: TopicOptions = DEFAULT_TOPICS, max_speed: float | None = None, named: bool = False
) -> tuple[TransformTree, int | None]:
    """The tree of a recording, and the log time of its first message in ns; warns of everything that is not in it.

    Parameters
    ----------
    file : Path
    topics : TopicOptions
    max_speed : float, optional
        In m/s; faster transforms are left out.
    named : bool
        Whether each warning names the file, because there are several.

    Raises
    ------
    RecordingError, UsageError
        As `TopicOptions.open`.
    """
    tree = TransformTree(keep=None)
    problems = Problems()
    limit = None if max_speed is None else SpeedLimit(max_speed)
    with topics.open(file) as recording, progress(recording.count, "reading") as advance:
        fill(tree, recording, problems, limit=limit, progress=advance)
        remarks, start = recording.remarks, recording.start
    warn_of_losses(file, problems, remarks, named)
    return tree, start


def warn_of_losses(file: Path, problems: Problems, remarks: Iterable[str], named: bool = False) -> None:
    """Warn of everything in a recording that was left out or not read; `named` puts the file before each line."""
    if problems:
        warn(f"left out of {file}: {format_counts(problems)}")
    for line in (*problems.details, *remarks):
        warn(f"{file}: {line}" if named else line)

"""Reading a whole recording for a command, with its progress and its losses on standard error."""

from collections.abc import Iterable
from pathlib import Path

from tfbus.cli.arguments import DEFAULT_TOPICS, TopicOptions
from tfbus.cli.output import format_counts, progress, warn
from tfbus.recording.recording import Problems, SpeedLimit, fill
from tfbus.tree.tree import TransformTree


def load_tree(
    file: Path, topics: TopicOptions = DEFAULT_TOPICS, max_speed: float | None = None
) -> tuple[TransformTree, int | None]:
    """The tree of a recording, and the log time of its first message in ns; warns of everything that is not in it.

    Parameters
    ----------
    file : Path
    topics : TopicOptions
    max_speed : float, optional
        In m/s; faster transforms are left out.

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
    warn_of_losses(file, problems, remarks)
    return tree, start


def warn_of_losses(file: Path, problems: Problems, remarks: Iterable[str]) -> None:
    """Warn of everything in a recording that was left out, and of what was not read."""
    if problems:
        warn(f"left out of {file}: {format_counts(problems)}")
    for line in (*problems.details, *remarks):
        warn(line)

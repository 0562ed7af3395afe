"""``tfbus convert``."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from tfbus.cli.arguments import Flag, Instant, UsageError, usage_errors
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import format_counts, progress, say, warn, write_file

with lazy_imports():
    from tfbus.recording.convert import Edits, StaticTransform
    from tfbus.recording.convert import convert as convert_recordings
    from tfbus.recording.recording import open_recording
    from tfbus.tree.rendering import quoted


def convert(
    source: Path,
    /,
    *further: Path,
    since: Annotated[Instant | None, Parameter(name="--from")] = None,
    until: Annotated[Instant | None, Parameter(name="--to")] = None,
    topics: tuple[str, ...] = (),
    frames: tuple[str, ...] = (),
    rename: tuple[str, ...] = (),
    prefix: str = "",
    drop_static: Flag = False,
    static_to_yaml: Path | None = None,
    overwrite: Flag = False,
    schema: Literal["ros", "foxglove"] = "ros",
) -> None:
    """Write recordings to a new one: in another format, a part of them, renamed, or several merged by their log times.

    The last file is the new one. Transforms keep every bit; messages on other topics are copied unchanged, or converted
    between ROS 1 and ROS 2 if the format needs it.

    Example: tfbus convert run.bag run.mcap --from 10 --to 20 --rename base_link=base

    Parameters
    ----------
    source
        A recording: .mcap, .db3 or .bag, a folder of ROS 2, or a trajectory of TUM, KITTI or EuRoC.
    further
        More recordings, and at last the new file: .mcap, .bag (ROS 1) or .db3 (ROS 2); for the trajectory of one frame
        .tum, .kitti or .euroc.
    since
        The start: seconds from the beginning of the first recording, a stamp in seconds, or a date. The static
        transforms from before come first.
    until
        The end, in the same ways.
    topics
        Write only this topic; may be given several times.
    frames
        Write only the transforms of this child frame; may be given several times.
    rename
        As OLD=NEW, another name for a frame; may be given several times.
    prefix
        A prefix for the names of all other frames.
    drop_static
        Leave out static transforms.
    static_to_yaml
        Write the last static transform of each frame to this file.
    overwrite
        Replace the new file if it exists.
    schema
        The schema of transforms: ROS' TFMessage, or Foxglove's FrameTransforms in Protocol Buffers, for .mcap only.
    """
    *inputs, output = (source, *further)
    if not inputs:
        raise UsageError("give the recordings, and at last the new file")
    with usage_errors():
        edits = Edits(frames or None, _pairs(rename), prefix, drop_static)
    with open_recording(inputs[0]) as recording:
        start = recording.start
    try:
        with progress(None, "converting") as advance:
            done = convert_recordings(
                inputs,
                output,
                None if since is None else since.stamp(start),
                None if until is None else until.stamp(start),
                topics=topics or None,
                edits=edits,
                overwrite=overwrite,
                schema=schema,
                progress=advance,
            )
    except FileExistsError:
        raise UsageError(f"{output} is there already: take another name, or give --overwrite") from None
    except ValueError as error:
        raise UsageError(str(error)) from None
    except OSError as error:
        raise UsageError(f"cannot write {output}: {error.strerror or error}") from None
    if static_to_yaml is not None:
        write_file(static_to_yaml, to_yaml(done.statics.values()).encode())
    say(f"{done.messages:,} messages with {done.transforms:,} transforms in {output}")
    if done.problems:
        warn(f"left out: {format_counts(done.problems)}")
    for detail in done.details:
        warn(detail)


def to_yaml(transforms: Iterable[StaticTransform]) -> str:
    """Static transforms as a list in YAML: parent, child, translation in m, and rotation as x, y, z, w."""
    lines = []
    for each in sorted(transforms, key=lambda each: each.child):
        lines += [
            f"- parent: {quoted(each.parent)}",
            f"  child: {quoted(each.child)}",
            f"  translation: [{', '.join(map(repr, each.translation))}]",
            f"  rotation: [{', '.join(map(repr, each.rotation))}]",
        ]
    return "\n".join([*(lines or ["[]"]), ""])


def _pairs(assignments: Sequence[str]) -> dict[str, str]:
    pairs = {}
    for assignment in assignments:
        old, equals, new = assignment.partition("=")
        if not (equals and old):
            raise UsageError(f"--rename is OLD=NEW, such as base_link=base, not {assignment!r}")
        pairs[old.lstrip("/")] = new
    return pairs

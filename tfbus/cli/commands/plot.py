"""``tfbus plot``."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from tfbus.cli.arguments import Flag, UsageError, usage_errors
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import say, track, write_file
from tfbus.cli.recordings import load_tree, warn_of_losses

with lazy_imports():
    from tfbus.errors import UnknownFrameError
    from tfbus.plain import printable
    from tfbus.recording.recording import Problems, open_recording

_KINDS = ("png", "svg", "pdf")


def plot(
    file: Path,
    /,
    *frames: str,
    output: Annotated[Path | None, Parameter(name=("--output", "-o"))] = None,
    path: Flag = False,
    three_d: Annotated[Flag, Parameter(name="--3d")] = False,
    gaps: Flag = False,
    text: Flag = False,
    compare: Path | None = None,
) -> None:
    """Plot the transforms of some frames from a recording over time: FILE TARGET SOURCE...

    The first of FRAMES is the target, in which the others are drawn: x, y and z in m, roll, pitch and yaw in degrees.

    Example: tfbus plot run.mcap map base_link lidar -o run.png

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, a folder of ROS 2, or a trajectory of TUM, KITTI or EuRoC.
    frames
        The target, then the sources. With --gaps, the frames to show; by default all.
    output
        Write a picture to this file: .png, .svg or .pdf; without it, a window opens.
    path
        Draw the path of each frame from above instead.
    three_d
        Draw the path of each frame in three dimensions.
    gaps
        Draw when each frame was heard instead, with histograms of the periods and delays.
    text
        Print the curves as lines of letters instead.
    compare
        Draw this recording over the first one.
    """
    if gaps and (path or three_d or text or compare is not None):
        raise UsageError("--gaps is a picture of its own: give no --path, --3d, --text or --compare with it")
    if text and (path or three_d or output is not None):
        raise UsageError("--text prints the curves over time: give no --path, --3d or --output with it")
    if not gaps and len(frames) < 2:
        raise UsageError("give the target and at least one source, such as: tfbus plot run.mcap map base_link")
    kind = None if output is None else picture_kind(output)
    plots = _plots()
    if gaps:
        problems = Problems()
        with open_recording(file) as recording:
            messages = problems.noting(recording.messages())
            reception = plots.read_reception(track(messages, recording.count, "reading"))
            remarks = recording.remarks
        warn_of_losses(file, problems, remarks)
        for frame in frames:
            if frame not in reception:
                raise UnknownFrameError(frame=frame, known=tuple(reception))
        if not reception:
            raise UsageError(f"there are no transforms in {file}")
        chosen = {frame: reception[frame] for frame in frames} if frames else reception
        draw_picture(lambda plots, figure: plots.plot_gaps(chosen, figure, recording=file.name), output, kind)
        return
    target, *sources = frames
    trees = [("", load_tree(file)[0])]
    if compare is not None:
        names = distinct_names(file, compare)
        trees = [(names[0], trees[0][1]), (names[1], load_tree(compare)[0])]
    if text:
        for name, tree in trees:
            for source in sources:
                if name:
                    print(printable(name))
                print(plots.sparklines(plots.read_series(tree, target, source)))
    else:
        named = file.name if compare is None else ""

        def draw(plots: Any, figure: Any) -> Any:
            if path or three_d:
                return plots.plot_path(trees, target, *sources, three_d=three_d, recording=named, figure=figure)
            return plots.plot_transforms(trees, target, *sources, recording=named, figure=figure)

        draw_picture(draw, output, kind)


def distinct_names(first: Path, second: Path) -> tuple[str, str]:
    """Short names that tell two files apart: without their ending, and with as many folders as it takes."""
    names = [[*path.parts[:-1], path.stem] for path in (first, second)]
    if first.stem == second.stem and first.suffix != second.suffix:
        return first.name, second.name
    for count in range(1, max(map(len, names)) + 1):
        one, other = ("/".join(parts[-count:]) for parts in names)
        if one != other:
            return one, other
    return str(first), f"{second} again"


def picture_kind(output: Path) -> str:
    """The format of a picture by the name of its file; raises `UsageError` for another ending."""
    kind = output.suffix.removeprefix(".").lower()
    if kind not in _KINDS:
        raise UsageError(f"cannot draw {output}: its name must end in .png, .svg or .pdf")
    return kind


def _plots() -> Any:
    with usage_errors():
        from tfbus import plot
    return plot


def draw_picture(draw: Callable[[Any, Any], Any], output: Path | None, kind: str | None) -> None:
    """Write a figure to a file, or show it in a window until that is closed.

    Parameters
    ----------
    draw : callable
        Draws with the module `tfbus.plot` into a figure, or a new one for None; returns the figure.
    output : Path, optional
    kind : str, optional
        Of `picture_kind`.
    """
    plots = _plots()
    if output is not None:
        picture = BytesIO()
        draw(plots, None).savefig(picture, format=kind, dpi=150)
        write_file(output, picture.getvalue())
        say(f"wrote {output}")
        return
    try:
        plots.show_in_window(lambda figure: draw(plots, figure))
    except RuntimeError as error:
        raise UsageError(f"{error}: write a picture with -o, or print the curves with --text") from None

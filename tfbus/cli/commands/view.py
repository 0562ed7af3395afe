"""``tfbus view``."""

from collections import Counter
from contextlib import AsyncExitStack
from pathlib import Path

from tfbus.cli.arguments import Port, Rate, UsageError, usage_errors
from tfbus.cli.domain import DEFAULT_HEARING, HearingOptions, run
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import format_counts, print_now, say, warn
from tfbus.cli.recordings import load_tree

with lazy_imports():
    import anyio

    from tfbus._aio.web_door import WebDoor
    from tfbus.buffer.buffer import Buffer
    from tfbus.bus.bus import Bus
    from tfbus.data import PointCloud
    from tfbus.errors import InvalidRobotError
    from tfbus.frames import check_frame
    from tfbus.recording.points import load_points


def view(
    file: Path | None = None,
    /,
    *,
    urdf: Path | None = None,
    package_path: tuple[Path, ...] = (),
    fixed: str | None = None,
    trail: tuple[str, ...] = (),
    points: tuple[str, ...] = (),
    edit: tuple[str, ...] = (),
    save: Path = Path("frames.yaml"),
    port: Port = 8080,
    host: str = "127.0.0.1",
    origin: tuple[str, ...] = (),
    rate: Rate = 30.0,
    link: HearingOptions = DEFAULT_HEARING,
) -> None:
    """Show the frames of a domain, or of a recording, as a live 3D page in the browser, until Ctrl-C.

    The address of the page is printed; only programs on this machine can open it, and no page of another site.

    Example: tfbus view run.mcap --urdf robot.urdf --points /scan

    Parameters
    ----------
    file
        A recording to look at instead of a domain: .mcap, .db3 or .bag, or a folder of ROS 2.
    urdf
        Draw the visible shapes of this robot at its frames.
    package_path
        Look for the meshes of package://NAME in this folder; may be given several times.
    fixed
        The frame that stands still; by default the root of the largest tree.
    trail
        Draw where this frame was in the last ten seconds; may be given several times.
    points
        Draw the clouds or scans on this topic of the recording, such as /scan; may be given several times.
    edit
        Let people move this static frame on the page, and publish it where they put it; may be given several times.
    save
        Write the moved frames to this file when somebody saves them on the page.
    port
        Serve the page at this port, or at the next free one; 0 for any.
    host
        Listen at this address; 0.0.0.0 lets all other machines see and use the page, and move the frames of --edit.
    origin
        Let pages of this other site use it too, such as https://robot.example; may be given several times.
    rate
        Draw at most this many times per second.
    """
    with usage_errors():
        from tfbus.view import View

        for frame in (*trail, *edit, *(() if fixed is None else (fixed,))):
            check_frame(frame)
        WebDoor(host, origin)
    if points and file is None:
        raise UsageError("--points shows a topic of a recording: name the file")

    async def show(bus: Bus, buffer: Buffer, live: bool) -> None:
        page = View(
            bus,
            buffer,
            port,
            host=host,
            origins=origin,
            fixed=fixed,
            trails=trail,
            urdf=urdf,
            package_paths=package_path,
            rate=rate,
            live=live,
            edit=edit,
            save=save if edit else None,
            title="tfbus" if file is None else file.name,
        )
        for topic, clouds in films.items():
            page.add_points(clouds, topic)
        async with AsyncExitStack() as stack:
            try:
                await stack.enter_async_context(page)
            except (InvalidRobotError, ImportError) as error:
                raise UsageError(str(error)) from None
            except OSError as error:
                what = error.filename or f"port {port}"
                raise UsageError(f"cannot use {what}: {error.strerror or error}") from None
            print_now(page.address)
            say("open this address in a browser; Ctrl-C ends it")
            await anyio.sleep_forever()

    async def show_domain(bus: Bus) -> None:
        with Buffer(bus) as buffer:
            await show(bus, buffer, live=True)

    films: dict[str, list[PointCloud]] = {}
    if file is None:
        link.run(show_domain)
        return
    recorded, _ = load_tree(file)
    for topic in points:
        problems: Counter[str] = Counter()
        films[topic] = load_points(file, topic, problems=problems)
        if problems:
            warn(f"left out of {topic}: {format_counts(problems)}")

    async def show_recording() -> None:
        with Bus() as bus, Buffer(bus, keep=None, prefill=recorded) as buffer:
            await show(bus, buffer, live=False)

    run(show_recording, link.backend)

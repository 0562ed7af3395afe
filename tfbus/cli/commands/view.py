"""``tfbus view``."""

from contextlib import AsyncExitStack
from pathlib import Path

from tfbus.cli.arguments import Port, Rate, UsageError, usage_errors
from tfbus.cli.domain import DEFAULT_HEARING, HearingOptions, run
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import print_now, say
from tfbus.cli.recordings import load_tree

with lazy_imports():
    import anyio

    from tfbus._aio.web_door import WebDoor
    from tfbus.buffer.buffer import Buffer
    from tfbus.bus.bus import Bus
    from tfbus.errors import InvalidRobotError
    from tfbus.frames import check_frame


def view(
    file: Path | None = None,
    /,
    *,
    urdf: Path | None = None,
    package_path: tuple[Path, ...] = (),
    fixed: str | None = None,
    trail: tuple[str, ...] = (),
    port: Port = 8080,
    host: str = "127.0.0.1",
    origin: tuple[str, ...] = (),
    rate: Rate = 30.0,
    link: HearingOptions = DEFAULT_HEARING,
) -> None:
    """Show the frames of a domain, or of a recording, as a live 3D page in the browser, until Ctrl-C.

    The address of the page is printed; only programs on this machine can open it, and no page of another site.

    Example: tfbus view run.mcap --urdf robot.urdf --trail base_link

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
    port
        Serve the page at this port, or at the next free one; 0 for any.
    host
        Listen at this address; 0.0.0.0 lets all other machines see and use the page.
    origin
        Let pages of this other site use it too, such as https://robot.example; may be given several times.
    rate
        Draw at most this many times per second.
    """
    with usage_errors():
        from tfbus.view import View

        for frame in trail if fixed is None else (*trail, fixed):
            check_frame(frame)
        WebDoor(host, origin)

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
        )
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

    if file is None:
        link.run(show_domain)
        return
    recorded, _ = load_tree(file)

    async def show_recording() -> None:
        with Bus() as bus, Buffer(bus, keep=None, prefill=recorded) as buffer:
            await show(bus, buffer, live=False)

    run(show_recording, link.backend)

"""``tfbus router``."""

import os
from pathlib import Path

from tfbus.cli.arguments import Backend, UsageError
from tfbus.cli.domain import run
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import say

with lazy_imports():
    import anyio

    from tfbus.errors import pip_install


def router(
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    config: Path | None = None,
    backend: Backend = "asyncio",
) -> None:
    """Connect the programs of all domains with each other, until Ctrl-C.

    A router is for programs on several machines, or of several users of one machine. They join with --connect. Each
    program needs one router; connected routers act as one.

    Example: tfbus router --listen tcp/192.168.1.5:7447

    Parameters
    ----------
    listen
        Listen at this address; may be given several times. By default at port 17447 of the loopback, which only this
        machine reaches.
    connect
        Connect to another router that listens at this address; may be given several times.
    config
        A file of zenoh's settings, in JSON5, such as the rules of access_control, which say who may publish.
    backend
        The event loop to run on.
    """
    try:
        from tfbus.links.zenoh import ZenohRouter
        from tfbus.links.zenoh.zenoh_router import ROUTER
    except ImportError:
        raise UsageError(f"a router needs one more package: {pip_install('cli,zenoh')}") from None

    addresses = listen or (ROUTER,)
    try:
        zenoh_router = ZenohRouter(addresses, connect=connect, config=config)
    except OSError as error:
        raise UsageError(f"cannot read {config}: {error.strerror}") from None
    except ValueError as error:
        raise UsageError(str(error)) from None

    async def route() -> None:
        try:
            async with zenoh_router:
                onward = f", and on to {' and '.join(connect)}" if connect else ""
                say(f"routing at {' and '.join(addresses)}{onward}, until Ctrl-C")
                await anyio.sleep_forever()
        except OSError as error:
            why = os.strerror(error.errno) if error.errno else error
            raise UsageError(f"cannot listen at {' or '.join(addresses)}: {why}") from None

    run(route, backend)

"""``tfbus router``."""

import os

import anyio

from tfbus.cli.arguments import Backend, UsageError
from tfbus.cli.domain import run
from tfbus.cli.output import say
from tfbus.errors import pip_install


def router(
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    backend: Backend = "asyncio",
) -> None:
    """Pass on what programs of all domains send each other, until Ctrl-C.

    For programs on several machines, or of several users of one. They connect to it with --connect; each program needs
    one router, and routers that are connected are as one.

    Example: tfbus router --listen tcp/192.168.1.5:7447

    Parameters
    ----------
    listen
        Listen at this address; may be given several times. By default at port 17447 of the loopback, which only this
        machine reaches.
    connect
        Connect to another router that listens at this address; may be given several times.
    backend
        The event loop to run on.
    """
    try:
        from tfbus.links.zenoh import ZenohRouter
        from tfbus.links.zenoh.zenoh_router import ROUTER
    except ImportError:
        raise UsageError(f"a router needs a package more: {pip_install('cli,zenoh')}") from None

    addresses = listen or (ROUTER,)

    async def route() -> None:
        try:
            async with ZenohRouter(addresses, connect=connect):
                onward = f", and on to {' and '.join(connect)}" if connect else ""
                say(f"routing at {' and '.join(addresses)}{onward}, until Ctrl-C")
                await anyio.sleep_forever()
        except OSError as error:
            why = os.strerror(error.errno) if error.errno else error
            raise UsageError(f"cannot listen at {' or '.join(addresses)}: {why}") from None
        except ValueError as error:
            raise UsageError(str(error)) from None

    run(route, backend)

"""``tfbus router``."""

import os

import anyio

from tfbus.cli.arguments import Backend, UsageError
from tfbus.cli.domain import run
from tfbus.cli.output import say
from tfbus.errors import pip_install

_ON_THIS_MACHINE = "tcp/127.0.0.1:17447"


def router(
    *,
    listen: tuple[str, ...] = (_ON_THIS_MACHINE,),
    connect: tuple[str, ...] = (),
    backend: Backend = "asyncio",
) -> None:
    """Connect the programs of all domains with each other, until Ctrl-C.

    A router is for programs on several machines, or of several users of one machine. They join with --connect. Each
    program needs one router; connected routers act as one.

    Example: tfbus router --listen tcp/192.168.1.5:7447

    Parameters
    ----------
    listen
        Listen at this address; may be given several times. Only this machine reaches the default.
    connect
        Connect to another router that listens at this address; may be given several times.
    backend
        The event loop to run on.
    """
    try:
        from tfbus.links.zenoh import ZenohRouter
    except ImportError:
        raise UsageError(f"a router needs one more package: {pip_install('cli,zenoh')}") from None

    async def route() -> None:
        try:
            async with ZenohRouter(listen, connect=connect):
                onward = f", and on to {' and '.join(connect)}" if connect else ""
                say(f"routing at {' and '.join(listen)}{onward}, until Ctrl-C")
                await anyio.sleep_forever()
        except OSError as error:
            why = os.strerror(error.errno) if error.errno else error
            raise UsageError(f"cannot listen at {' or '.join(listen)}: {why}") from None
        except ValueError as error:
            raise UsageError(str(error)) from None

    run(route, backend)

"""The cost of knowing peers that do nothing: one link, and some peers in two other processes.

The peers know the measured link, but not each other, so that the machine carries them.
"""

import json
import subprocess
import sys
import time
from contextlib import AsyncExitStack
from typing import Any
from uuid import uuid4

import anyio
import anyio.to_thread
import zenoh

from tfbus import Bus
from tfbus.links.zenoh import ZenohLink, ZenohRouter
from tfbus.links.zenoh._settings import settings

PROCESSES = 2
ALONE = {"scouting/gossip/enabled": False}


async def join(
    stack: AsyncExitStack, task: dict[str, Any], how_many: int, address: dict[str, Any], **more: Any
) -> list[Any]:
    """Open links, or bare sessions."""
    own = task["config"] | more.pop("config", {})
    if task["bare"]:
        config = settings(address.get("listen"), address.get("connect"), own, None)
        return [await anyio.to_thread.run_sync(zenoh.open, config) for _ in range(how_many)]
    made = []
    for _ in range(how_many):
        bus = stack.enter_context(Bus())
        link = ZenohLink(bus, task["domain"], config=own, **address, **more)
        made.append(await stack.enter_async_context(link))
    return made


def known(end: Any) -> int:
    """The number of others that an end knows."""
    return len(list(end.info.peers_zid())) if isinstance(end, zenoh.Session) else len(end.peers)


async def be_peers(task: dict[str, Any]) -> None:
    async with AsyncExitStack() as stack:
        ends = await join(
            stack,
            task,
            task["peers"] // PROCESSES,
            {"connect": task["address"]},
            robot="other",
            robots=["one"],
            config=ALONE,
        )
        await anyio.to_thread.run_sync(sys.stdin.read)
        del ends


async def be_router(task: dict[str, Any]) -> None:
    async with ZenohRouter(task["address"]):
        print("ready", flush=True)
        await anyio.to_thread.run_sync(sys.stdin.read)


async def be_measured(task: dict[str, Any]) -> None:
    side = "connect" if task["router"] else "listen"
    async with AsyncExitStack() as stack:
        ends = await join(stack, task, 1, {side: task["address"]}, robot="one")
        print("ready", flush=True)
        while known(ends[0]) < task["peers"]:  # noqa: ASYNC110 - zenoh's threads wake no event here
            await anyio.sleep(0.1)
        await anyio.sleep(task["settle"])
        before, began = time.process_time(), time.monotonic()
        await anyio.sleep(task["seconds"])
        cores = (time.process_time() - before) / (time.monotonic() - began)
        print(json.dumps({"cores": cores, "peers": known(ends[0])}), flush=True)


def measure(settle: float, bare: bool = False, router: bool = False, peers: int = 50, seconds: float = 30.0) -> float:
    """The user and system time of the measured process, in cores.

    `bare` measures zenoh's sessions with the same settings and nothing on them: the floor; with a `router` the links
    meet as its clients.
    """
    # The other processes do not find it.
    from support.processes import free_address

    task = {
        "address": free_address(),
        "domain": f"presence-{uuid4().hex}",
        "config": {"mode": "client"} if router else {},
        "peers": peers,
        "seconds": seconds,
        "settle": settle,
        "bare": bare,
        "router": router,
    }

    def start(role: str) -> subprocess.Popen[str]:
        command = [sys.executable, __file__, role, json.dumps(task)]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    started: list[subprocess.Popen[str]] = []

    def tell_line(process: subprocess.Popen[str]) -> str:
        assert process.stdout is not None
        return process.stdout.readline()

    try:
        if router:
            started.append(start("router"))
            tell_line(started[-1])
        measured = start("measured")
        started.append(measured)
        tell_line(measured)
        started += [start("peers") for _ in range(PROCESSES)]
        told = json.loads(tell_line(measured))
    finally:
        for process in started:
            process.kill()
            process.communicate()
    if told["peers"] != peers:
        raise RuntimeError(f"{told['peers']} peers were there at the end, not {peers}")
    return float(told["cores"])


if __name__ == "__main__":
    roles = {"peers": be_peers, "router": be_router, "measured": be_measured}
    anyio.run(roles[sys.argv[1]], json.loads(sys.argv[2]))

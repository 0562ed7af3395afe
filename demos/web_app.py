"""A web service that looks up transforms, waits for them if necessary, and streams their changes.

The bus, the buffer and a robot that drives in a circle live in the application's lifespan. The routes are

    GET /                                                a page that shows the tree and follows the robot
    GET /tree                                            the tree as text
    GET /transforms/robot1/laser                         the newest, in the frame map
    GET /transforms/robot1/laser?target=robot1/base_link another target
    GET /transforms/robot1/laser?at=1250000000           at a stamp, in ns
    GET /transforms/robot1/laser?timeout=0.2             waits no longer than 0.2 s (by default 1 s, at most 60 s)
    GET /changes/robot1/laser                            Server-Sent Events: each change, at most 10 in a second
    WebSocket /poses/robot1/laser                        each change, at most 20 in a second

`tfbus.web.status_of` gives the statuses of errors: 404 for a frame that nobody has published, 504 when the time is up,
503 while the service ends. A WebSocket closes with 4404 for 404. A signal ends all streams and waits at once.

A browser connects to this machine for any web page. So the service answers to its own names only (`HOSTS`), and opens a
WebSocket only for its own pages and the pages of `ORIGINS`.

Run it with `pip install ".[web]"`, then `python demos/web_app.py`, and open http://127.0.0.1:8000.
"""

import contextlib
import json
import math
from collections.abc import AsyncGenerator
from typing import Annotated, Any

import anyio
import fastapi
import uvicorn
from fastapi.requests import HTTPConnection
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse, StreamingResponse
from fastapi.websockets import WebSocketDisconnect
from starlette.middleware.trustedhost import TrustedHostMiddleware

import tfbus

HOSTS = ["127.0.0.1", "localhost"]
"""The names by which browsers may reach the service; a page can have any other name lead here."""
ORIGINS: list[str] = []
"""Other pages that may open a WebSocket, such as https://robot.example."""
LONGEST_WAIT = 60.0
"""s; a client that asks for more would hold on to a task of the service."""

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Where is the robot?</title>
<link rel="icon" href="data:image/svg+xml,<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 16 16' stroke-width='3'
  stroke-linecap='round'><path d='M3 13h10' stroke='%23d33'/><path d='M3 13V3' stroke='%232a2'/></svg>">
<style>
:root { color-scheme: light dark; --line: light-dark(#d5dae2, #39414e); --soft: light-dark(#5b6573, #9aa5b5);
  --card: light-dark(#fff, #1c2129); --robot: light-dark(#1663c7, #6fb0ff) }
body { margin: 0 auto; padding: 1.5rem; max-width: 60rem; font: 1rem/1.5 system-ui, sans-serif;
  background: light-dark(#f4f6f9, #13171d) }
header { display: flex; flex-wrap: wrap; gap: .25rem 1rem; align-items: baseline; margin-bottom: 1rem }
h1 { font-size: 1.5rem; margin: 0 }
h2 { font-size: .8rem; font-weight: 600; color: var(--soft); margin: 0 0 .5rem }
main { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fit, minmax(min(20rem, 100%), 1fr)) }
section { align-self: start; min-width: 0; padding: 1rem;
  background: var(--card); border: 1px solid var(--line); border-radius: .6rem }
section.wide { grid-column: 1 / -1 }
#map { width: 100%; aspect-ratio: 1; max-height: 24rem; display: block }
#grid { stroke: var(--line) } #map circle { fill: none; stroke: var(--line); stroke-dasharray: .04 }
#map, dd { font-variant-numeric: tabular-nums }
dl { display: grid; grid-template-columns: auto 1fr; gap: .2rem 1rem; margin: 0 }
dt { color: var(--soft) } dd { margin: 0; text-align: right }
pre { margin: 0; overflow-x: auto; font: .85rem/1.5 ui-monospace, monospace }
#state { color: var(--soft) } #state.lost { color: #c0392b; font-weight: 600 }
</style>
<header><h1>Where is the robot?</h1><span id="state" role="status">connecting</span></header>
<main>
<section><h2>map, from above; the grid is 0.5 m</h2>
<svg id="map" viewBox="-1.5 -1.5 3 3" stroke-width=".01" role="img" aria-label="The robot in the map">
<g id="grid"></g><circle r="1"/>
<path id="robot" fill="var(--robot)" d="M.16 0 -.1 .1 -.05 0 -.1-.1Z" visibility="hidden"/></svg></section>
<section><h2>robot1/laser in map</h2>
<dl><dt>x</dt><dd id="x">–</dd><dt>y</dt><dd id="y">–</dd><dt>z</dt><dd id="z">–</dd>
<dt>stamp</dt><dd id="stamp">–</dd></dl></section>
<section class="wide"><h2>all frames</h2><pre id="tree"></pre></section>
</main>
<script>
const element = (id) => document.getElementById(id);
for (let at = -1.5; at <= 1.5; at += 0.5)
  element("grid").innerHTML += `<path d="M${at} -2V2M-2 ${at}H2"/>`;

const lost = new Set();
const report = (stream, isOpen) => {
  isOpen ? lost.delete(stream) : lost.add(stream);
  element("state").className = lost.size ? "lost" : "";
  element("state").textContent = lost.size ? "connection lost, reconnecting" : "live";
};
const followRobot = () => {
  const poses = new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}/poses/robot1/base_link`);
  poses.onopen = () => report("poses", true);
  poses.onclose = () => { report("poses", false); setTimeout(followRobot, 1000); };
  poses.onmessage = (message) => {
    const { translation: [x, y], rotation: [, , qz, qw] } = JSON.parse(message.data).transform;
    const heading = -2 * Math.atan2(qz, qw) * 180 / Math.PI;
    element("robot").setAttribute("transform", `translate(${x} ${-y}) rotate(${heading})`);
    element("robot").setAttribute("visibility", "visible");
  };
};
const followLaser = () => {
  const changes = new EventSource("/changes/robot1/laser");
  changes.onopen = () => report("changes", true);
  changes.onerror = () => { changes.close(); report("changes", false); setTimeout(followLaser, 1000); };
  changes.onmessage = (message) => {
    const { stamp, transform: { translation } } = JSON.parse(message.data);
    ["x", "y", "z"].forEach((axis, i) => { element(axis).textContent = `${translation[i].toFixed(2)} m`; });
    element("stamp").textContent = new Date(stamp / 1e6).toLocaleTimeString();
  };
};
const showTree = async () => {
  try { element("tree").textContent = await (await fetch("/tree")).text(); } catch { /* the streams report it */ }
  setTimeout(showTree, 1000);
};
followRobot(); followLaser(); showTree();
</script>
</html>
"""


async def drive(bus: tfbus.Bus) -> None:
    """Send a robot that goes round a circle of 1 m at 0.5 rad/s."""
    odometry = tfbus.TransformBroadcaster(bus, authority="odometry")
    async for tick in bus.clock.ticks(50.0):
        angle = 0.5 * tick / 50.0
        position = (math.cos(angle), math.sin(angle), 0.0)
        pose = tfbus.Transform.from_axis_angle((0, 0, 1), angle + math.pi / 2, position)
        odometry.send("map", "robot1/base_link", pose)


@contextlib.asynccontextmanager
async def lifespan(app: fastapi.FastAPI) -> AsyncGenerator[None]:
    with tfbus.Bus() as bus, tfbus.Buffer(bus) as app.state.buffer, tfbus.web.close_on_signal(app.state.buffer):
        calibration = tfbus.TransformBroadcaster(bus, authority="calibration")
        calibration.send_static("robot1/base_link", "robot1/laser", tfbus.Transform((0.1, 0.0, 0.2)))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(drive, bus)
            yield
            tasks.cancel_scope.cancel()


async def buffer_of(connection: HTTPConnection) -> tfbus.Buffer:
    buffer: tfbus.Buffer = connection.app.state.buffer
    return buffer


app = fastapi.FastAPI(lifespan=lifespan)
app.add_middleware(TrustedHostMiddleware, allowed_hosts=HOSTS, www_redirect=False)
OurBuffer = Annotated[tfbus.Buffer, fastapi.Depends(buffer_of)]
Stamp = Annotated[int, fastapi.Query(ge=-(2**63), lt=2**63)]
Timeout = Annotated[float, fastapi.Query(ge=0.0, le=LONGEST_WAIT)]


@app.exception_handler(tfbus.TransformError)
async def no_answer(_: HTTPConnection, error: tfbus.TransformError) -> JSONResponse:
    return JSONResponse(error.to_dict(), tfbus.web.status_of(error))


@app.get("/", response_class=HTMLResponse)
async def page() -> str:
    return PAGE


@app.get("/tree", response_class=PlainTextResponse)
async def tree(buffer: OurBuffer) -> str:
    return buffer.describe()


@app.get("/transforms/{frame:path}")
async def transform(
    buffer: OurBuffer, frame: str, target: str = "map", at: Stamp | None = None, timeout: Timeout = 1.0
) -> dict[str, Any]:
    found = await buffer.lookup(target, frame, tfbus.LATEST if at is None else at, timeout=timeout)
    return found.to_dict()


@app.get("/changes/{frame:path}")
async def changes(buffer: OurBuffer, frame: str, target: str = "map") -> StreamingResponse:
    # A stream of an unknown frame would wait for it in silence.
    await buffer.lookup(target, frame, timeout=1.0)

    async def events() -> AsyncGenerator[str]:
        with buffer.watch(target, frame, max_rate=10.0) as watch:
            async for found in watch:
                yield f"data: {json.dumps(found.to_dict())}\n\n"

    return StreamingResponse(events(), media_type="text/event-stream")


@app.websocket("/poses/{frame:path}")
async def poses(socket: fastapi.WebSocket, buffer: OurBuffer, frame: str, target: str = "map") -> None:
    # Programs other than browsers send no origin.
    origin = socket.headers.get("origin")
    if origin not in (None, f"http://{socket.headers.get('host')}", *ORIGINS):
        await socket.close()
        return
    await socket.accept()
    try:
        await buffer.lookup(target, frame, timeout=1.0)
    except tfbus.TransformError as error:
        await socket.close(4000 + tfbus.web.status_of(error))
        return
    with buffer.watch(target, frame, max_rate=20.0) as watch:

        async def notice_the_end() -> None:
            while (await socket.receive())["type"] != "websocket.disconnect":
                pass
            watch.close()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(notice_the_end)
            with contextlib.suppress(WebSocketDisconnect):
                async for found in watch:
                    await socket.send_json(found.to_dict())
            tasks.cancel_scope.cancel()
    # The client or the server may have closed it already.
    with contextlib.suppress(RuntimeError, WebSocketDisconnect):
        await socket.close(1012, "the service ends")


if __name__ == "__main__":
    print("http://127.0.0.1:8000", flush=True)
    # A client that has stopped reading its stream does not hold up the end for longer than that.
    uvicorn.run(
        app, host="127.0.0.1", port=8000, log_level="warning", limit_concurrency=500, timeout_graceful_shutdown=3
    )

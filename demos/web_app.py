"""A web service that looks up transforms, waits for them if necessary, and streams their changes.

The bus, the buffer and a robot that drives in a circle live in the application's lifespan. The routes are

    GET /                                           a page that shows the tree and follows the robot
    GET /tree                                       the tree as text
    GET /transforms/map/base_link                   the newest
    GET /transforms/map/base_link?at=1250000000     at a stamp, in ns
    GET /transforms/map/base_link?timeout=0.2       waits no longer than 0.2 s (by default 1 s, at most 60 s)
    GET /changes/map/base_link                      Server-Sent Events: each change, at most 10 in a second
    WebSocket /poses/map/base_link                  each change, at most 20 in a second

A lookup answers 200 with JSON, 404 with close matches for a frame that nobody has published, 504 with the reason when
the time is up, 400 for a question that can never be answered, and 503 while the service is going down.

A browser connects to this machine for any web page. So the service answers to its own names only (`HOSTS`), and opens a
WebSocket only for its own pages and the pages of `ORIGINS`.

Run it with `pip install ".[web]"`, then `python demos/web_app.py`, and open http://127.0.0.1:8000.
"""

import contextlib
import json
import math
from collections.abc import AsyncIterator

import anyio
import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

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
<title>tfbus</title>
<style>body { font-family: sans-serif } canvas { border: 1px solid gray }</style>
<h1>Where is the robot?</h1>
<canvas id="map" width="300" height="300"></canvas>
<p>Laser in the map: <output id="laser">waiting</output></p>
<pre id="tree"></pre>
<script>
const map = document.getElementById("map").getContext("2d");
const pixel = ([x, y]) => [150 + 100 * x, 150 - 100 * y];
const poses = new WebSocket(`ws://${location.host}/poses/map/base_link`);
poses.onmessage = (message) => {
  const { translation } = JSON.parse(message.data).transform;
  const [x, y] = pixel(translation);
  map.clearRect(0, 0, 300, 300);
  map.fillRect(x - 5, y - 5, 10, 10);
};
const changes = new EventSource("/changes/map/laser");
changes.onmessage = (message) => {
  const { translation } = JSON.parse(message.data).transform;
  document.getElementById("laser").value = translation.map((metres) => metres.toFixed(2)).join(", ");
};
const showTree = async () => {
  document.getElementById("tree").textContent = await (await fetch("/tree")).text();
};
showTree();
setInterval(showTree, 1000);
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
        odometry.send("map", "base_link", pose)


@contextlib.asynccontextmanager
async def lifespan(_: Starlette) -> AsyncIterator[dict[str, tfbus.Buffer]]:
    with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer:
        calibration = tfbus.TransformBroadcaster(bus, authority="calibration")
        calibration.send_static("base_link", "laser", tfbus.Transform((0.1, 0.0, 0.2)))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(drive, bus)
            yield {"buffer": buffer}
            tasks.cancel_scope.cancel()


def buffer_of(connection: HTTPConnection) -> tfbus.Buffer:
    buffer: tfbus.Buffer = connection.state.buffer
    return buffer


async def page(_: Request) -> Response:
    return HTMLResponse(PAGE)


async def tree(request: Request) -> Response:
    return PlainTextResponse(buffer_of(request).describe())


async def transform(request: Request) -> Response:
    target, source = request.path_params["target"], request.path_params["source"]
    try:
        at = int(request.query_params["at"]) if "at" in request.query_params else tfbus.LATEST
        timeout = float(request.query_params.get("timeout", 1.0))
        if timeout > LONGEST_WAIT:
            raise ValueError(f"a timeout must be at most {LONGEST_WAIT:g} s, got {timeout!r} s")
        found = await buffer_of(request).lookup(target, source, at, timeout=timeout)
    except tfbus.LookupTimeoutError as error:
        missing = error.__cause__
        if isinstance(missing, tfbus.UnknownFrameError):
            return JSONResponse({"error": str(missing), "close_matches": missing.close_matches}, 404)
        return JSONResponse({"error": str(error)}, 504)
    except (tfbus.TransformLookupError, ValueError) as error:
        return JSONResponse({"error": str(error)}, 400)
    except tfbus.BusClosedError as error:
        return JSONResponse({"error": str(error)}, 503)
    return JSONResponse(found.to_dict())


async def changes(request: Request) -> Response:
    target, source = request.path_params["target"], request.path_params["source"]

    async def events() -> AsyncIterator[str]:
        with buffer_of(request).watch(target, source, max_rate=10.0) as watch:
            async for found in watch:
                yield f"data: {json.dumps(found.to_dict())}\n\n"

    return StreamingResponse(events(), media_type="text/event-stream")


async def poses(socket: WebSocket) -> None:
    target, source = socket.path_params["target"], socket.path_params["source"]
    # Programs other than browsers send no origin.
    origin = socket.headers.get("origin")
    if origin not in (None, f"http://{socket.headers.get('host')}", *ORIGINS):
        await socket.close()
        return
    await socket.accept()
    # The service notices at the next message that a client has gone.
    with contextlib.suppress(WebSocketDisconnect):
        with buffer_of(socket).watch(target, source, max_rate=20.0) as watch:
            async for found in watch:
                await socket.send_json(found.to_dict())
        await socket.close()


app = Starlette(
    routes=[
        Route("/", page),
        Route("/tree", tree),
        Route("/transforms/{target}/{source}", transform),
        Route("/changes/{target}/{source}", changes),
        WebSocketRoute("/poses/{target}/{source}", poses),
    ],
    middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=HOSTS, www_redirect=False)],
    lifespan=lifespan,
)

if __name__ == "__main__":
    print("http://127.0.0.1:8000", flush=True)
    # A stream has no end, so the server does not wait for it at its own end.
    uvicorn.run(
        app, host="127.0.0.1", port=8000, log_level="warning", limit_concurrency=100, timeout_graceful_shutdown=1
    )

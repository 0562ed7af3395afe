"""A web service that answers where a frame is, and waits for the answer if it must.

The bus, the buffer and a robot that drives in a circle live in the application's lifespan. One route awaits:

    GET /transforms/map/base_link                   the newest
    GET /transforms/map/base_link?at=1250000000     at a stamp, in ns
    GET /transforms/map/base_link?timeout=0.2       waits no longer than 0.2 s (by default 1 s)

It answers 200 with JSON, 404 with close matches for a frame that nobody has published, 504 with the reason when the
time is up, 400 for a question that can never be answered, and 503 while the service is going down.

Run it with `pip install ".[web]"`, then `python demos/web_app.py`, and ask http://127.0.0.1:8000/transforms/map/base_link.
"""

import contextlib
import math
from collections.abc import AsyncIterator

import anyio
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

import tfbus


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


async def transform(request: Request) -> JSONResponse:
    buffer: tfbus.Buffer = request.state.buffer
    target, source = request.path_params["target"], request.path_params["source"]
    try:
        at = int(request.query_params["at"]) if "at" in request.query_params else tfbus.LATEST
        timeout = float(request.query_params.get("timeout", 1.0))
        found = await buffer.lookup(target, source, at, timeout=timeout)
    except tfbus.LookupTimeoutError as error:
        missing = error.__cause__
        if isinstance(missing, tfbus.UnknownFrameError):
            return JSONResponse({"error": str(missing), "close_matches": missing.close_matches}, 404)
        return JSONResponse({"error": str(error)}, 504)
    except (tfbus.TransformLookupError, ValueError) as error:
        return JSONResponse({"error": str(error)}, 400)
    except tfbus.BusClosedError as error:
        return JSONResponse({"error": str(error)}, 503)
    return JSONResponse(
        {
            "target": found.parent,
            "source": found.child,
            "stamp": found.stamp,
            "translation": found.transform.translation,
            "rotation": found.transform.rotation,
        }
    )


app = Starlette(routes=[Route("/transforms/{target}/{source}", transform)], lifespan=lifespan)

if __name__ == "__main__":
    uvicorn.run(app, host="127.0.0.1", port=8000)

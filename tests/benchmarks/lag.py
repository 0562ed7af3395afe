"""The lag of an event loop."""

from time import perf_counter

import anyio

PROBE = 0.001


async def probe(lags: list[float]) -> None:
    """The seconds by which a task that sleeps is woken too late."""
    while True:
        due = perf_counter() + PROBE
        await anyio.sleep(PROBE)
        lags.append(perf_counter() - due)

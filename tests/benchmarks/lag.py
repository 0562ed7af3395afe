"""How late an event loop is."""

from time import perf_counter

import anyio

PROBE = 0.001


async def probe(lags: list[float]) -> None:
    """How much later than it asked for a task that sleeps is woken."""
    while True:
        due = perf_counter() + PROBE
        await anyio.sleep(PROBE)
        lags.append(perf_counter() - due)

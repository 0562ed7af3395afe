"""A program of a user, at Ctrl-C: the recipe of `LocalLink` ends it without a traceback, on every event loop."""

import sys

import pytest
from support.processes import Program, new_domain

PROGRAM = """
import asyncio, sys, anyio, tfbus

async def main():
    try:
        with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer:
            async with tfbus.LocalLink(bus, sys.argv[2]), anyio.create_task_group() as tasks:
                tasks.start_soon(buffer.lookup, "map", "nowhere")
                async for _ in bus.clock.ticks(200.0):
                    bus.publish(tfbus.TransformStamped("map", "base", bus.clock.now(), tfbus.Transform()))
                    # At the first tick the lookup's task may not have begun.
                    if buffer.pending():
                        print("on", flush=True)
    finally:
        print("left", flush=True)

try:
    asyncio.run(main()) if sys.argv[1] == "asyncio.run" else anyio.run(main, backend=sys.argv[1])
except* KeyboardInterrupt:
    pass
"""


@pytest.mark.parametrize("loop", ["asyncio.run", pytest.param("asyncio", marks=pytest.mark.thorough), "trio"])
def test_a_program_ends_at_ctrl_c_in_order_and_without_a_traceback(loop: str) -> None:
    with Program(sys.executable, "-P", "-c", PROGRAM, loop, new_domain()) as program:
        program.output.expect("on")
        assert program.end() == 0
        assert program.output.text.endswith("left\n")
        assert program.errors.text == ""

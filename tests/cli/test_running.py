import os
import signal

import anyio
import anyio.lowlevel
import pytest

from tfbus.cli.running import run

pytestmark = pytest.mark.parametrize("backend", ["asyncio", "trio"])


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_what_a_command_does_is_done_when_it_returns(backend: str) -> None:
    done = []

    async def main() -> None:
        await anyio.lowlevel.checkpoint()
        done.append(backend)

    run(main, backend)
    assert done == [backend]


def test_ctrl_c_cancels_and_is_raised_when_all_has_ended_in_order_although_it_is_pressed_again(backend: str) -> None:
    ended = []

    async def main() -> None:
        try:
            press_ctrl_c()
            await anyio.sleep_forever()
        finally:
            with anyio.CancelScope(shield=True):
                for _ in range(3):
                    press_ctrl_c()
                    await anyio.sleep(0.01)
            ended.append(backend)

    with pytest.raises(KeyboardInterrupt):
        run(main, backend)
    assert ended == [backend]


def test_what_was_done_before_ctrl_c_came_is_no_less_interrupted(backend: str) -> None:
    async def main() -> None:
        with anyio.CancelScope(shield=True):
            press_ctrl_c()
            await anyio.sleep(0.01)

    with pytest.raises(KeyboardInterrupt):
        run(main, backend)


def test_an_error_comes_out_as_it_is(backend: str) -> None:
    async def main() -> None:
        raise OSError("no")

    with pytest.raises(OSError, match="no"):
        run(main, backend)


def test_an_error_at_the_end_is_told_although_ctrl_c_came_first(backend: str) -> None:
    async def main() -> None:
        try:
            press_ctrl_c()
            await anyio.sleep_forever()
        finally:
            raise OSError("no")

    with pytest.raises(OSError, match="no"):
        run(main, backend)


def test_where_ctrl_c_is_ignored_it_stays_so(backend: str) -> None:
    done = []

    async def main() -> None:
        press_ctrl_c()
        await anyio.sleep(0.01)
        done.append(backend)

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        run(main, backend)
    finally:
        signal.signal(signal.SIGINT, before)
    assert done == [backend]

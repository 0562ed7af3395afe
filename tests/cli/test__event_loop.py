import os
import signal

import anyio
import anyio.lowlevel
import pytest

from tfbus.cli._event_loop import run

pytestmark = pytest.mark.parametrize("backend", ["asyncio", "trio"])


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_the_result_of_the_function_is_returned(backend: str) -> None:
    async def main() -> str:
        await anyio.lowlevel.checkpoint()
        return backend

    assert run(main, backend) == backend


def test_ctrl_c_cancels_and_is_raised_after_the_cleanup_even_if_pressed_again(backend: str) -> None:
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


def test_ctrl_c_is_raised_even_if_the_function_ends_by_itself(backend: str) -> None:
    async def main() -> None:
        with anyio.CancelScope(shield=True):
            press_ctrl_c()
            await anyio.sleep(0.01)

    with pytest.raises(KeyboardInterrupt):
        run(main, backend)


def test_an_error_is_raised_without_an_exception_group(backend: str) -> None:
    async def main() -> None:
        raise OSError("no")

    with pytest.raises(OSError, match="no"):
        run(main, backend)


def test_an_error_in_the_cleanup_after_ctrl_c_is_raised(backend: str) -> None:
    async def main() -> None:
        try:
            press_ctrl_c()
            await anyio.sleep_forever()
        finally:
            raise OSError("no")

    with pytest.raises(OSError, match="no"):
        run(main, backend)


def test_ctrl_c_stays_ignored_where_it_was_ignored(backend: str) -> None:
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

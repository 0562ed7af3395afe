import anyio
import pytest
from support.asking import settle

from tfbus._aio.task_groups import close_task_group, raise_unchanged

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]


class Alarm(BaseException):
    """An error that is no `Exception`."""


async def fail(error: BaseException) -> None:
    raise error


async def close_with(*errors: BaseException) -> None:
    """Close a group whose tasks raise these errors in one turn of the loop."""
    tasks = anyio.create_task_group()
    await tasks.__aenter__()
    for error in errors:
        tasks.start_soon(fail, error)
    await close_task_group(tasks)


async def test_closing_waits_for_all_tasks() -> None:
    steps: list[str] = []
    released = anyio.Event()

    async def work() -> None:
        await released.wait()
        steps.append("worked")

    async def close() -> None:
        tasks = anyio.create_task_group()
        await tasks.__aenter__()
        tasks.start_soon(work)
        await close_task_group(tasks)
        steps.append("closed")

    async with anyio.create_task_group() as outer:
        outer.start_soon(close)
        await settle()
        assert steps == []
        released.set()
    assert steps == ["worked", "closed"]


@pytest.mark.parametrize("kind", [KeyError, Alarm])
async def test_the_error_of_a_single_failed_task_is_raised_as_it_is(kind: type[BaseException]) -> None:
    error = kind("failed")
    with pytest.raises(kind) as caught:
        await close_with(error)
    assert caught.value is error


@pytest.mark.parametrize("in_one_task", [True, False])
async def test_a_group_that_one_task_raises_and_the_errors_of_several_tasks_are_a_group(in_one_task: bool) -> None:
    errors = [KeyError("a"), ValueError("b")]
    with pytest.raises(ExceptionGroup) as caught:
        await close_with(*([ExceptionGroup("own", errors)] if in_one_task else errors))
    assert {*caught.value.exceptions} == {*errors}


async def test_the_error_of_a_task_keeps_its_cause_and_its_context() -> None:
    cause, context = KeyError("cause"), ValueError("context")

    async def work() -> None:
        try:
            raise context
        except ValueError:
            raise RuntimeError("work") from cause

    tasks = anyio.create_task_group()
    await tasks.__aenter__()
    tasks.start_soon(work)
    with pytest.raises(RuntimeError, match="work") as caught:
        try:
            raise KeyError("body")
        except KeyError:
            await close_task_group(tasks)
    assert caught.value.__cause__ is cause
    assert caught.value.__context__ is context


def test_an_error_that_is_raised_unchanged_keeps_the_context_it_had() -> None:
    error, first = RuntimeError("kept"), KeyError("first")
    error.__context__ = first
    for context in (first, None):
        error.__context__ = context
        with pytest.raises(RuntimeError, match="kept") as caught:
            try:
                raise ValueError("handled meanwhile")
            except ValueError:
                raise_unchanged(error)
        assert caught.value is error
        assert caught.value.__context__ is context

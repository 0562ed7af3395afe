"""The end of tasks that belong to an object which is an ``async with`` itself."""

import anyio.abc


async def close_task_group(tasks: anyio.abc.TaskGroup) -> None:
    """Wait until all tasks of a group have ended that was entered by hand; what one of them raises comes out as it is.

    A group that is left in the usual way wraps what the body has raised as well, so it is not told of that.
    """
    try:
        await tasks.__aexit__(None, None, None)
    except BaseExceptionGroup as group:
        if len(group.exceptions) > 1:
            raise
        raise group.exceptions[0] from None

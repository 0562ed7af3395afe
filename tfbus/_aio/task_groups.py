"""Task groups that belong to an object with an ``async with`` of its own."""

from typing import NoReturn

import anyio.abc


async def close_task_group(tasks: anyio.abc.TaskGroup) -> None:
    """Wait until all tasks have ended, and raise the error of a single failed task without an `ExceptionGroup`.

    The group was entered by hand. It is not told of an error in the body of the ``async with``, because it would wrap
    that error as well.
    """
    try:
        await tasks.__aexit__(None, None, None)
    except BaseExceptionGroup as group:
        error: BaseException = group
        # A task may have had a group of its own.
        while isinstance(error, BaseExceptionGroup):
            if len(error.exceptions) > 1:
                raise
            error = error.exceptions[0]
    else:
        return
    raise_unchanged(error)


def raise_unchanged(error: BaseException) -> NoReturn:
    """Raise an error that was caught before, with the context that it had then."""
    context = error.__context__
    try:
        raise error
    finally:
        # `raise` has replaced the context by the exception that is being handled.
        error.__context__ = context
        del error

"""The parts of the kernel that runs. Other modules import every twin from here; `tfbus.running_kernel` chooses.

`tfbus._python_kernel` is the definition: ``_c_kernel/`` does the same, with the same bits. The fast paths of publishing
and waiting exist in C only, because in Python they would not be faster than the ordinary ones: `Intake` takes a plain
batch, and the `Feed` of each tree stores it and wakes the lookups that waited for it. Another `Feed`, of each buffer,
asks and parks the plain ones.
"""

import functools
from collections.abc import Callable
from typing import Any, Final, Literal, TypeVar, cast

from tfbus.running_kernel import running_kernel
from tfbus.stamps import LATEST

Kernel = Literal["compiled", "python"]
MethodT = TypeVar("MethodT", bound=Callable[..., Any])


kernel: Final = cast(Kernel, running_kernel)
"""The kernel that runs in this process."""

if kernel == "python":
    from tfbus._python_kernel import (
        Chain,
        Edge,
        History,
        Judge,
        Line,
        Parked,
        Paths,
        Sample,
        columns,
        commit,
        compose_paths,
        compose_rows,
        decode,
        decode_whole,
        fill_matrix,
        invert_row,
        move_point,
        move_points,
        row_of_matrix,
    )

    Feed: Any = None
    Intake: Any = None
else:
    from tfbus._kernel import (
        Chain,
        Edge,
        Feed,
        History,
        Intake,
        Judge,
        Line,
        Parked,
        Paths,
        Sample,
        columns,
        commit,
        compose_paths,
        compose_rows,
        decode,
        decode_whole,
        fill_matrix,
        invert_row,
        move_point,
        move_points,
        row_of_matrix,
    )

__all__ = [
    "Chain",
    "Edge",
    "Feed",
    "History",
    "Intake",
    "Judge",
    "Line",
    "Parked",
    "Paths",
    "Sample",
    "columns",
    "commit",
    "compose_paths",
    "compose_rows",
    "decode",
    "decode_whole",
    "fill_matrix",
    "invert_row",
    "kernel",
    "move_point",
    "move_points",
    "plain_first",
    "row_of_matrix",
]


def plain_first(method: MethodT, many: type | None = None) -> MethodT:
    """A method that runs only if ``self._paths`` has no plain answer; that answer must be the method's own.

    This is the only place that tries the plain answer for the synchronous methods. Calling a Python method with many
    keyword arguments takes as long as the answer itself, so the compiled kernel answers before the call.

    Parameters
    ----------
    method : function
        ``(self, target, source, at=LATEST, ...)``. If ``self._paths`` is None, it always runs.
    many : type, optional
        The array type of the answers, if `method` takes stamps instead of `at`. Only the compiled kernel has plain
        answers at many stamps.
    """
    if kernel == "compiled":
        from tfbus._kernel import Method

        return cast(MethodT, Method(method, many))
    if many is not None:
        return method

    @functools.wraps(method)
    def first(self: Any, target: str, source: str, at: Any = LATEST, **options: Any) -> Any:
        if not options and self._paths is not None:
            found = self._paths.answer(target, source, at)
            if found is not None:
                return found
        return method(self, target, source, at, **options)

    return cast(MethodT, first)

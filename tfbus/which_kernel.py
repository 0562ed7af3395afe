"""The choice between the compiled kernel and its twin in Python. Other modules import every twin from here.

The environment variable ``TFBUS_KERNEL`` asks for ``python`` or ``compiled``. Without it, the compiled kernel runs if
it was built and can be loaded. In a checkout's root, Python finds the checkout before the installed package; if only
the latter has a compiled kernel, a warning says so.

`tfbus._python_kernel` is the definition: ``_c_kernel/`` does the same, with the same bits. The fast paths of publishing
and waiting exist in C only, because in Python they would not be faster than the ordinary ones: `Intake` takes a plain
batch, and the `Feed` of each tree stores it and wakes the lookups that waited for it. Another `Feed`, of each buffer,
asks and parks the plain ones.
"""

import functools
import importlib
import os
import sys
from collections.abc import Callable
from typing import Any, Final, Literal, TypeVar, cast

Kernel = Literal["compiled", "python"]
MethodT = TypeVar("MethodT", bound=Callable[..., Any])


def _choose(wanted: str | None) -> Kernel:
    """The kernel that runs.

    Raises
    ------
    ImportError
        If the compiled kernel is asked for and cannot be loaded.
    ValueError
        If something else is asked for.
    """
    if wanted == "python":
        return "python"
    if wanted not in (None, "", "compiled"):
        raise ValueError(f"TFBUS_KERNEL must be 'python' or 'compiled', not {wanted!r}")
    try:
        importlib.import_module("tfbus._kernel")
    except ImportError:
        if wanted == "compiled":
            raise
        if not wanted:
            _warn_of_shadowed_kernel()
        return "python"
    return "compiled"


def _warn_of_shadowed_kernel() -> None:
    """Warn if another installation of this package has the compiled kernel that this one lacks."""
    import warnings
    from importlib.machinery import PathFinder
    from pathlib import Path

    here = Path(__file__).resolve().parent
    folders = (Path(entry, "tfbus").resolve() for entry in sys.path)
    spec = PathFinder.find_spec("tfbus._kernel", [str(folder) for folder in folders if folder != here])
    if spec is not None and spec.origin is not None:
        warnings.warn(
            f"tfbus is loaded from {here}, which has no compiled kernel, and not from {Path(spec.origin).parent}, "
            "which has one: lookups take more than ten times as long. Run the program in another folder or with "
            "python -P, or install the checkout with pip install -e . (TFBUS_KERNEL=python asks for the kernel in "
            "Python, without this warning.)",
            RuntimeWarning,
            stacklevel=2,
        )


kernel: Final = _choose(os.environ.get("TFBUS_KERNEL"))
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
    from tfbus._kernel import (  # type: ignore[assignment]
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
    # Here, because it loads numpy, which `tfbus --version` does without.
    from tfbus.stamps import LATEST

    @functools.wraps(method)
    def first(self: Any, target: str, source: str, at: Any = LATEST, **options: Any) -> Any:
        if not options and self._paths is not None:
            found = self._paths.answer(target, source, at)
            if found is not None:
                return found
        return method(self, target, source, at, **options)

    return cast(MethodT, first)

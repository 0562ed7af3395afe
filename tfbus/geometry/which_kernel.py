"""The choice between the compiled kernel and its Python twin.

The environment variable ``TFBUS_KERNEL`` asks for ``python`` or ``compiled``. Without it, the compiled one runs where
it was built and can be loaded.
"""

import importlib
import os
from typing import Final, Literal

Kernel = Literal["compiled", "python"]


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
        return "python"
    return "compiled"


kernel: Final = _choose(os.environ.get("TFBUS_KERNEL"))
"""The kernel that runs in this process."""

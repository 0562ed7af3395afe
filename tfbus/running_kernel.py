"""The choice between the compiled kernel and its twin in Python; `tfbus --version` loads no more than this.

The environment variable ``TFBUS_KERNEL`` asks for ``python`` or ``compiled``. Without it, the compiled kernel runs if
it was built and can be loaded.
"""

import os


def _choose(wanted: str | None) -> str:
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
        import tfbus._kernel  # noqa: F401
    except ImportError:
        if wanted == "compiled":
            raise
        return "python"
    return "compiled"


running_kernel = _choose(os.environ.get("TFBUS_KERNEL"))
"""``"compiled"`` or ``"python"``."""

"""The choice between the compiled kernel and its twin in Python; `tfbus --version` loads no more than this.

The environment variable ``TFBUS_KERNEL`` asks for ``python`` or ``compiled``. Without it, the compiled kernel runs if
it was built and can be loaded. In a checkout's root, Python finds the checkout before the installed package; if only
the latter has a compiled kernel, a warning says so.
"""

import os
import sys


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


running_kernel: str = _choose(os.environ.get("TFBUS_KERNEL"))
"""``"compiled"`` or ``"python"``."""

"""The choice between the compiled kernel and its twin in Python; `tfbus --version` loads no more than this.

The environment variable ``TFBUS_KERNEL`` asks for ``python`` or ``compiled``. Without it, the compiled kernel runs if
it was built and can be loaded. In a checkout's root, Python finds the checkout before the installed package; if only
the latter has a compiled kernel, a warning says so. A checkout has the sources of the compiled kernel, too. If they
have changed since it was built, a warning says that, and the kernel in Python runs.
"""

import os
import sys


def _choose(wanted: str | None) -> str:
    """The kernel that runs.

    Raises
    ------
    ImportError
        If the compiled kernel is asked for, and cannot be loaded or was built from other sources.
    ValueError
        If something else is asked for.
    """
    if wanted == "python":
        return "python"
    if wanted not in (None, "", "compiled"):
        raise ValueError(f"TFBUS_KERNEL must be 'python' or 'compiled', not {wanted!r}")
    try:
        import tfbus._kernel as built
    except ImportError:
        if wanted == "compiled":
            raise
        if not wanted:
            _warn_of_shadowed_kernel()
        return "python"
    folder = os.path.join(os.path.dirname(__file__), "_c_kernel")  # noqa: PTH118, PTH120 - pathlib takes long to load
    if not os.path.isdir(folder) or getattr(built, "sources", None) == _checksum(folder):  # noqa: PTH112
        return "compiled"
    stale = (
        f"{built.__file__} was compiled from other sources than those in {folder}: compile it again with "
        "pip install -e . in the checkout, or ask for the kernel in Python with TFBUS_KERNEL=python"
    )
    if wanted:
        raise ImportError(stale)
    import warnings

    warnings.warn(f"{stale}, which runs now: lookups take more than ten times as long", RuntimeWarning, stacklevel=2)
    return "python"


def _checksum(folder: str) -> int:
    """The checksum of the sources in a folder, as `tfbus/_build.py` compiles it into the kernel."""
    import zlib

    total = 0
    for name in sorted(name for name in os.listdir(folder) if name.endswith((".c", ".h"))):  # noqa: PTH208
        with open(os.path.join(folder, name), "rb") as file:  # noqa: PTH118, PTH123
            total = zlib.crc32(file.read(), total)
    return total & 0x7FFF_FFFF


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

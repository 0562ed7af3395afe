"""The version, which needs nothing but the kernel."""

from tfbus import __version__
from tfbus.running_kernel import running_kernel


def version() -> str:
    """The version of the package, and the kernel that runs."""
    return f"{__version__} ({running_kernel} kernel)"

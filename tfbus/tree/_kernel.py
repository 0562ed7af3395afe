"""The kernel that runs: the compiled one, or its definition in Python."""

from tfbus.geometry.which_kernel import kernel
from tfbus.tree._python_kernel import ONE_BY_ONE, Columns, Held

if kernel == "python":
    from tfbus.tree._python_composition import compose_paths
    from tfbus.tree._python_kernel import Chain, History, Paths, commit
else:
    from tfbus._kernel import Chain, History, Paths, commit, compose_paths  # type: ignore[assignment]

__all__ = ["ONE_BY_ONE", "Chain", "Columns", "Held", "History", "Paths", "commit", "compose_paths"]

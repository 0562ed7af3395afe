"""The plain insertion that runs: the compiled one, or its definition in Python."""

from tfbus.geometry.which_kernel import kernel

if kernel == "python":
    from tfbus.waiting._python_feed import Feed, Line, Parked
else:
    from tfbus._kernel import Feed, Line, Parked  # type: ignore[assignment]

__all__ = ["Feed", "Line", "Parked"]

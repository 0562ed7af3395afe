"""The plain judgement and the plain intake that run: the compiled ones, or their definitions in Python."""

from tfbus.geometry.which_kernel import kernel

if kernel == "python":
    from tfbus.bus._python_intake import Intake
    from tfbus.bus._python_judge import Edge, Judge
else:
    from tfbus._kernel import Edge, Intake, Judge  # type: ignore[assignment]

__all__ = ["Edge", "Intake", "Judge"]

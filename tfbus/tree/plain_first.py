"""Methods that ask the kernel for the plain answer before any code in Python runs.

The frame of a method with many keyword arguments takes as long as the answer itself. The compiled kernel therefore
stands before it: where the call has nothing but target, source and stamps, and the kernel knows the answer, the method
does not run. The Python kernel cannot be quicker than the method, and leaves it as it is.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from tfbus.geometry.transform_array import TransformArray
from tfbus.geometry.which_kernel import kernel

MethodT = TypeVar("MethodT", bound=Callable[..., Any])


def plain_first(method: MethodT) -> MethodT:
    """A method `(self, target, source, at=LATEST, ...)` that runs only if ``self._paths.answer`` has no answer.

    Without `Paths` under that name it always runs. It must give the same answer.
    """
    return _ahead_of(method, None)


def plain_many_first(method: MethodT) -> MethodT:
    """As `plain_first`, of a method `(self, target, source, stamps, ...)` and ``self._paths.answer_many``."""
    return _ahead_of(method, TransformArray)


def _ahead_of(method: MethodT, many: type[TransformArray] | None) -> MethodT:
    if kernel == "python":
        return method
    from tfbus._kernel import Method

    return cast(MethodT, Method(method, many))

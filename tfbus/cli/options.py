"""What the options of several commands mean."""

from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

Rate = Annotated[float, Parameter(validator=Number(gt=0, lt=float("inf")))]
Duration = Annotated[float, Parameter(validator=Number(gte=0))]
Backend = Literal["asyncio", "trio"]

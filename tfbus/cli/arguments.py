"""The argument types of the subcommands."""

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from typing import Annotated, Any, Literal

from cyclopts import Parameter, Token
from cyclopts.validators import Number

from tfbus.stamps import SECOND, STAMP_MAX

_LIMIT = Decimal(STAMP_MAX // SECOND)


class UsageError(Exception):
    """An argument cannot be used: the command prints the message in one line and exits with status 2."""


class Seconds(int):
    """Nanoseconds that are typed in seconds; the help shows the name of this class."""


def parse_seconds(text: str) -> int:
    """Nanoseconds from decimal seconds, exactly.

    Raises
    ------
    ValueError
        If the text is not a number, has more than nine decimals, or does not fit 64-bit nanoseconds.
    """
    try:
        number = Decimal(text)
        # Arithmetic rounds to the context's precision; a comparison does not.
        fits = -_LIMIT < number < _LIMIT
    except InvalidOperation:
        raise ValueError(f"expected seconds, not {text!r}") from None
    if not fits:
        raise ValueError(f"{text} s does not fit 64-bit nanoseconds")
    nanoseconds = int(number.scaleb(9))
    if Decimal(nanoseconds).scaleb(-9) != number:
        raise ValueError(f"{text} has more than nine decimals: an instant is told in nanoseconds")
    return nanoseconds


def _convert_instant(_: Any, tokens: Sequence[Token]) -> Seconds:
    return Seconds(parse_seconds(tokens[0].value))


def _convert_step(_: Any, tokens: Sequence[Token]) -> Seconds:
    text = tokens[0].value
    step = Seconds(parse_seconds(text))
    if step <= 0:
        raise ValueError(f"expected more than 0 s, not {text}")
    return step


Backend = Literal["asyncio", "trio"]
"""An event loop."""
Rate = Annotated[float, Parameter(validator=Number(gt=0, lt=float("inf")))]
"""A frequency in Hz."""
Speed = Annotated[float, Parameter(validator=Number(gt=0))]
"""A speed relative to real time; may be infinite."""
Duration = Annotated[float, Parameter(validator=Number(gte=0))]
"""A duration in s; may be infinite."""
Instant = Annotated[Seconds, Parameter(converter=_convert_instant)]
"""A stamp, or an offset between two, in ns."""
Step = Annotated[Seconds, Parameter(converter=_convert_step)]
"""A period in ns, greater than zero."""
Flag = Annotated[bool, Parameter(negative="", show_default=False)]
"""An option without a value."""
JsonFlag = Annotated[bool, Parameter(name="--json", negative="", show_default=False)]
"""The flag ``--json``."""

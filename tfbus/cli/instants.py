"""Instants as they are typed and printed: decimal seconds, exact to the nanosecond."""

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from typing import Annotated, Any

from cyclopts import Parameter, Token

from tfbus.stamps import SECOND, STAMP_MAX

_LIMIT = Decimal(STAMP_MAX // SECOND)


class Seconds(int):
    """Nanoseconds that are typed in seconds; the help shows the name."""


def nanoseconds(text: str) -> int:
    """The instant that a number of seconds is, in ns.

    Raises
    ------
    ValueError
        If it is no number, has more than nine decimals, or does not fit 64 bits.
    """
    try:
        number = Decimal(text)
        # Compared as they are, because arithmetic has only so many digits.
        fits = -_LIMIT < number < _LIMIT
    except InvalidOperation:
        raise ValueError(f"expected seconds, not {text!r}") from None
    if not fits:
        raise ValueError(f"{text} s does not fit 64-bit nanoseconds")
    stamp = int(number.scaleb(9))
    if Decimal(stamp).scaleb(-9) != number:
        raise ValueError(f"{text} has more than nine decimals: an instant is told in nanoseconds")
    return stamp


def seconds(stamp: int) -> str:
    """An instant in s, with all nine decimals."""
    whole, rest = divmod(abs(stamp), SECOND)
    return f"{'-' if stamp < 0 else ''}{whole}.{rest:09d}"


def _instant(_: Any, tokens: Sequence[Token]) -> Seconds:
    return Seconds(nanoseconds(tokens[0].value))


def _step(_: Any, tokens: Sequence[Token]) -> Seconds:
    step = _instant(_, tokens)
    if step <= 0:
        raise ValueError(f"expected more than 0 s, not {tokens[0].value}")
    return step


Instant = Annotated[Seconds, Parameter(converter=_instant)]
Step = Annotated[Seconds, Parameter(converter=_step)]

"""The types of the arguments of the subcommands, and the error for an argument that cannot be used."""

import calendar
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from typing import Annotated, Any, Final, Literal, NamedTuple

from cyclopts import Parameter, Token
from cyclopts.validators import Number

_LIMIT = Decimal(2**63 // 10**9)
"""The number of seconds that 64-bit nanoseconds can hold."""
_FIRST_ABSOLUTE: Final = 100_000_000 * 10**9
"""The first stamp, in ns, that cannot be a time from the beginning of a recording: it is in 1973, or after 3 years."""
_DATE = re.compile(r"\d{4}-\d\d")
_FRACTION = re.compile(r"(.*?)(\.\d+)?(Z|[+-]\d\d:?\d\d)?")


class UsageError(Exception):
    """An argument cannot be used: the command prints the message in one line and exits with status 2."""


@contextmanager
def usage_errors() -> Iterator[None]:
    """Raise a `ValueError` or an `ImportError` of the body of a ``with`` as a `UsageError` with the same message."""
    try:
        yield
    except (ValueError, ImportError) as error:
        raise UsageError(str(error)) from None


_INSTANT = "expected seconds, or a date such as 2014-03-31T19:24:50, not {!r}"


def is_number(word: str) -> bool:
    """Whether a word that was typed is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


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


class Time(NamedTuple):
    """An instant of a recording, as a user types it; the help shows the name of this class."""

    nanoseconds: int
    absolute: bool
    """Whether it is a stamp; else it is counted from the beginning of the recording."""

    def stamp(self, start: int | None) -> int:
        """The stamp in ns, of a recording that starts at a log time; without any message, it starts at 0."""
        return self.nanoseconds if self.absolute else (start or 0) + self.nanoseconds


def parse_time(text: str) -> Time:
    """An instant from seconds or from a date.

    A number below 10⁸ counts from the beginning of the recording, a greater one is a stamp. A date is in
    ISO 8601, such as ``2014-03-31T19:24:50.25``, and in UTC unless it says otherwise.

    Raises
    ------
    ValueError
        If the text is neither, is negative, has more than nine decimals, or does not fit 64-bit nanoseconds.
    """
    if _DATE.match(text.strip()):
        return Time(_parse_date(text.strip()), absolute=True)
    if not is_number(text):
        raise ValueError(_INSTANT.format(text))
    nanoseconds = parse_seconds(text)
    if nanoseconds < 0:
        raise ValueError(f"expected a time from the beginning on, not {text}")
    return Time(nanoseconds, nanoseconds >= _FIRST_ABSOLUTE)


def _parse_date(text: str) -> int:
    # A `datetime` has microseconds.
    head, digits, zone = _FRACTION.fullmatch(text).groups()  # type: ignore[union-attr]  # matches every text
    try:
        date = datetime.fromisoformat(head + (zone or ""))
        seconds = calendar.timegm((date if date.tzinfo else date.replace(tzinfo=UTC)).utctimetuple())
    except (ValueError, OverflowError):
        raise ValueError(_INSTANT.format(text)) from None
    return parse_seconds(f"{seconds}{digits or ''}" if seconds >= 0 else str(seconds))


def _convert_time(_: Any, tokens: Sequence[Token]) -> Time:
    return parse_time(tokens[0].value)


def _convert_step(_: Any, tokens: Sequence[Token]) -> Seconds:
    text = tokens[0].value
    step = Seconds(parse_seconds(text))
    if step <= 0:
        raise ValueError(f"expected more than 0 s, not {text}")
    return step


Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Backend = Literal["asyncio", "trio"]
"""An event loop."""
Rate = Annotated[float, Parameter(validator=Number(gt=0, lt=float("inf")))]
"""A frequency in Hz."""
Port = Annotated[int, Parameter(validator=Number(gte=0, lte=65_535))]
"""A port of this machine; 0 for any that is free."""
Speed = Annotated[float, Parameter(validator=Number(gt=0))]
"""A speed relative to real time; may be infinite."""
Duration = Annotated[float, Parameter(validator=Number(gte=0))]
"""A duration in s; may be infinite."""
Instant = Annotated[Time, Parameter(converter=_convert_time, n_tokens=1, accepts_keys=False)]
"""An instant of a recording."""
Step = Annotated[Seconds, Parameter(converter=_convert_step)]
"""A period in ns, greater than zero."""
Flag = Annotated[bool, Parameter(negative="")]
"""An option without a value."""
Positive = Annotated[float, Parameter(validator=Number(gt=0))]
"""A number greater than zero; may be infinite."""
JsonFlag = Annotated[Flag, Parameter(name="--json")]
"""The flag ``--json``."""
CsvFlag = Annotated[Flag, Parameter(name="--csv")]
"""The flag ``--csv``."""

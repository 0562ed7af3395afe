"""Plain data, as in JSON: the shared part of `to_dict` and `from_dict` of all classes; and plain text.

Numbers, texts and None stay; a tuple becomes a list, a mapping a dict, and `LATEST` the text ``"LATEST"``. A number
that is not finite becomes a text, because JSON has no such numbers: ``"NaN"``, ``"Infinity"`` or ``"-Infinity"``, as in
the JSON of protobuf. An array becomes a dict of its dtype, its shape, and its values, row by row.
"""

import math
import re
import types
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import cache
from typing import Any, Literal, Self, TypeAlias, Union, get_args, get_origin, get_type_hints

import numpy as np

from tfbus.stamps import LATEST, Latest

_NOT_FINITE = ("NaN", "Infinity", "-Infinity")
_INTEGER = re.compile("-?[0-9]{1,20}")
StampsAs: TypeAlias = Literal["int", "text"]
"""Stamps as numbers, or as text: the numbers of JavaScript are exact up to 2**53, and a stamp of today is larger."""
_PLAIN = frozenset((types.NoneType, bool, int, str))


def printable(text: str) -> str:
    """A text in which the characters that `repr` would escape are escaped, so that it stays in its line.

    These are control and format characters, which begin a new line, command a terminal, or reverse the direction of
    letters; blanks other than the usual one; and code points that are not characters. Letters of any alphabet stay. A
    second call changes nothing, so a line may be made of names and of texts that are printable already.
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


class PlainData:
    """A base of dataclasses that gives them `to_dict` and `from_dict`."""

    __slots__ = ()

    def to_dict(self, *, stamps: StampsAs = "int") -> dict[str, Any]:
        """The fields as plain data for JSON, with the name of the class as ``"type"``; stamps are ``int`` of ns.

        With ``stamps="text"``, the fields `stamp` and `stamps` are text, for programs in JavaScript, whose numbers are
        not exact beyond 2**53. `from_dict` reads both.
        """
        values: dict[str, Any] = {"type": type(self).__name__}
        for name in _kinds_of_fields(type(self)):  # type: ignore[arg-type]
            value = getattr(self, name)
            values[name] = value if type(value) in _PLAIN else to_plain(value)
        return values if stamps == "int" else with_text(values, stamps)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The object from which `to_dict` made `data`.

        Raises
        ------
        ValueError
            If a field is missing, unknown or of another kind, or the class refuses its value. The message names it.
        """
        return cls(**from_fields(cls, data, _kinds_of_fields(cls)))  # type: ignore[arg-type]


def with_text(values: dict[str, Any], stamps: str) -> dict[str, Any]:
    """Plain data with text as `stamp` and `stamps`.

    Raises
    ------
    ValueError
        If `stamps` is not ``"text"``.
    """
    if stamps != "text":
        raise ValueError(f"stamps must be 'int' or 'text', not {stamps!r}")
    if values.get("stamp") is not None:
        values["stamp"] = str(values["stamp"])
    if isinstance(values.get("stamps"), dict):
        values["stamps"]["values"] = [str(stamp) for stamp in values["stamps"]["values"]]
    return values


def schema_of(kind: Any, kinds: Mapping[str, Any], defaults: Mapping[str, Any], handler: Any) -> Any:
    """The schema by which pydantic reads and writes a class that has `to_dict` and `from_dict`.

    Parameters
    ----------
    kind : type
    kinds : mapping of str to type
        The type of each field.
    defaults : mapping
        The values of fields that may be missing; a field that is None here is passed on only if it is given.
    handler : pydantic.GetCoreSchemaHandler
    """
    from pydantic_core import core_schema

    def validate(value: Any, read: Callable[[Any], Any]) -> Any:
        if isinstance(value, kind):
            return value
        given = {**defaults, **read(value)}
        return kind.from_dict({name: part for name, part in given.items() if part is not None})

    def write(value: Any) -> dict[str, Any]:
        # The values behind the keys of `to_dict`: the schema has a way of its own to write each of them.
        return {name: getattr(value, name, part) for name, part in value.to_dict().items()}

    fields = {
        name: core_schema.typed_dict_field(handler.generate_schema(hint), required=name not in defaults)
        for name, hint in {"type": Literal[kind.__name__], **kinds}.items()
    }
    plain = core_schema.typed_dict_schema(fields, cls_name=kind.__name__, extra_behavior="forbid")
    return core_schema.no_info_wrap_validator_function(
        validate,
        plain,
        ref=f"{kind.__module__}.{kind.__qualname__}",
        serialization=core_schema.plain_serializer_function_ser_schema(write, return_schema=plain),
    )


def to_plain(value: Any) -> Any:
    """Plain data of a value.

    Raises
    ------
    TypeError
        If its type has none.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return _plain_float(float(value))
    if isinstance(value, Latest):
        return value.value
    if isinstance(value, Mapping):
        return {name: to_plain(part) for name, part in value.items()}
    if isinstance(value, (tuple, list)):
        return [to_plain(part) for part in value]
    if isinstance(value, np.ndarray):
        values = value.ravel().tolist()
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            values = [_plain_float(part) for part in values]
        return {"dtype": value.dtype.name, "shape": list(value.shape), "values": values}
    if isinstance(value, BaseException) and not hasattr(value, "to_dict"):
        return {"type": type(value).__name__, "message": str(value)}
    if hasattr(value, "to_dict"):
        return value.to_dict()
    raise TypeError(f"there are no plain data for {value!r}")


def from_fields(cls: type, data: Mapping[str, Any], kinds: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of plain data of a class.

    Parameters
    ----------
    cls : type
        Its name must be the ``"type"`` of the data, if there is one.
    data : mapping
    kinds : mapping of str to type
        The type of each field; the data must have all of them, and no others.

    Raises
    ------
    ValueError
        If a field is missing, unknown or of another kind. The message names it.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"a {cls.__name__} is a dict of its fields, not {data!r}")  # noqa: TRY004 - the data are wrong
    given = dict(data)
    kind = given.pop("type", cls.__name__)
    if kind != cls.__name__:
        raise ValueError(f"a {cls.__name__} cannot be made of the data of a {kind!r}")
    for name in given.keys() ^ kinds.keys():
        raise ValueError(f"{cls.__name__} {'needs the' if name in kinds else 'has no'} field {name!r}")
    found = {}
    for name, kind in kinds.items():
        value = given[name]
        # Nearly all fields are plain, and a call and a name for each would cost more than everything else.
        found[name] = value if type(value) in _exact(kind) else from_plain(kind, value, f"{cls.__name__}.{name}")
    return found


def from_plain(hint: Any, value: Any, name: str) -> Any:
    """The value of type `hint` of its plain data.

    Raises
    ------
    ValueError
        If the plain data are of another kind. The message has `name`.
    """
    if type(value) is hint:
        return value
    problem = ""
    for kind, read in _readers_of(hint):
        try:
            found = read(kind, value, name)
        except ValueError as error:
            problem = f": {error}"
        else:
            if found is not _OTHER:
                return found
    raise ValueError(f"{name} cannot be {value!r}{problem}")


@cache
def _exact(hint: Any) -> frozenset[Any]:
    """The types of values that are their own plain data and cannot be read as another alternative of a type."""
    readers = dict(_readers_of(hint))
    exact = {kind for kind, read in readers.items() if read in (_read_exact, _read_int)}
    if len(exact) < len(readers):
        # Some texts are numbers that are not finite, or `LATEST`.
        exact.discard(str)
    if float in readers:
        exact.discard(int)
        exact.add(float)
    return frozenset(exact)


@cache
def _readers_of(hint: Any) -> tuple[tuple[Any, Callable[[Any, Any, str], Any]], ...]:
    """The alternatives of a type, and the function that reads each of them."""
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    return tuple((kind, _READERS.get(_origin_of(kind), _read_dict)) for kind in kinds)


def _origin_of(kind: Any) -> Any:
    """The class behind a type; from Python 3.12 on, an array of numpy is behind an alias."""
    origin = get_origin(kind) or kind
    alias = getattr(origin, "__value__", None)
    return origin if alias is None else _origin_of(alias)


_OTHER = object()
"""The answer of a reader for data of another kind."""


def _read_exact(kind: type, value: Any, _name: str) -> Any:
    return value if type(value) is kind else _OTHER


def _read_int(kind: type, value: Any, name: str) -> Any:
    if isinstance(value, str) and name.endswith((".stamp", ".stamps")) and _INTEGER.fullmatch(value):
        return int(value)
    return _read_exact(kind, value, name)


def _read_dict(kind: Any, value: Any, _name: str) -> Any:
    return kind.from_dict(value) if isinstance(value, Mapping) else _OTHER


def _read_float(_kind: Any, value: Any, _name: str) -> Any:
    if value in _NOT_FINITE and isinstance(value, str):
        return float(value)
    try:
        return float(value) if type(value) in (int, float) else _OTHER
    except OverflowError:
        raise ValueError(f"an integer of {value.bit_length()} bits is too large for a float") from None


def _read_latest(_kind: Any, value: Any, _name: str) -> Any:
    return LATEST if value == LATEST.value else _OTHER


def _read_tuple(kind: Any, value: Any, name: str) -> Any:
    parts = get_args(kind)
    if not isinstance(value, (list, tuple)):
        return _OTHER
    if parts[-1] is not Ellipsis and len(parts) != len(value):
        return _OTHER
    hints = [parts[0]] * len(value) if parts[-1] is Ellipsis else parts
    if all(type(part) is hint for part, hint in zip(value, hints, strict=True)):
        return tuple(value)
    return tuple(
        from_plain(hint, part, f"{name}[{i}]") for i, (hint, part) in enumerate(zip(hints, value, strict=True))
    )


def _read_mapping(kind: Any, value: Any, name: str) -> Any:
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        return _OTHER
    return {key: from_plain(get_args(kind)[1], part, f"{name}[{key!r}]") for key, part in value.items()}


def _read_array(_kind: Any, value: Any, name: str) -> Any:
    if not isinstance(value, Mapping) or value.keys() != {"dtype", "shape", "values"}:
        return _OTHER
    try:
        dtype = np.dtype(value["dtype"])
        if dtype.kind not in "biuf":
            return _OTHER
        values = value["values"]
        if dtype.kind in "iu":
            values = [_read_int(int, part, name) for part in values]
        # numpy would cut off fractions, and read numbers in any text.
        wanted = {"b": (bool,), "f": (int, float)}.get(dtype.kind, (int,))
        if not all(type(part) in wanted or (dtype.kind == "f" and part in _NOT_FINITE) for part in values):
            return _OTHER
        return np.array(values, dtype).reshape(value["shape"])
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} is not an array: {error}") from None


def _read_error(_kind: Any, value: Any, _name: str) -> Any:
    # An error of another library comes back as its text.
    if not isinstance(value, Mapping) or value.keys() != {"type", "message"}:
        return _OTHER
    return Exception(f"{value['type']}: {value['message']}")


_READERS: dict[Any, Any] = {
    types.NoneType: _read_exact,
    bool: _read_exact,
    int: _read_int,
    str: _read_exact,
    float: _read_float,
    Latest: _read_latest,
    tuple: _read_tuple,
    Mapping: _read_mapping,
    np.ndarray: _read_array,
    Exception: _read_error,
}


def _plain_float(value: float) -> float | str:
    if math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


@cache
def _kinds_of_fields(cls: Any) -> dict[str, Any]:
    hints = get_type_hints(cls)
    return {field.name: hints[field.name] for field in fields(cls)}

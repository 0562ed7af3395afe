"""Static transforms in a file: a calibration that is written once and published at each start."""

import json
import math
import os
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

from tfbus.errors import InvalidTransformError, MissingRecordingError, RecordingError, pip_install
from tfbus.geometry.stamped import TransformStamped, as_batch
from tfbus.geometry.transform import Transform
from tfbus.recording.formats.storage import MAX_INDEX, MAX_METADATA
from tfbus.stamps import is_real
from tfbus.tree.tree import TransformTree

_SIZES = {"xyz": 3, "rpy": 3, "rpy_deg": 3, "quaternion": 4}
_SAME = {"translation": "xyz", "rotation": "quaternion"}
"""The names that ``tfbus convert --static-to-yaml`` writes."""
_ROTATIONS = ("rpy", "rpy_deg", "quaternion")
_NAMED: Final = 10
_LONGEST: Final = 1_000
"""The greatest length of an error, in letters."""


class HasTree(Protocol):
    """An object with a tree, such as a `tfbus.Buffer`."""

    @property
    def tree(self) -> TransformTree:
        """The tree."""


def save_static(path: str | os.PathLike[str], source: HasTree | TransformTree | Iterable[TransformStamped]) -> None:
    """Write static transforms to a file that `load_static` reads, as JSON, which is YAML as well.

    Parameters
    ----------
    path : path
    source : Buffer, TransformTree, or iterable of TransformStamped
        Of a buffer or a tree, all static frames are written, with the names of the bus. Rotations are written as
        quaternions x, y, z, w, to the last bit.

    Raises
    ------
    ValueError
        If a sample moves, or a tree has moving frames only; the message names them. Nothing is written.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> tree = TransformTree()
    >>> outcome = tree.insert(TransformStamped("base_link", "laser", 0, Transform((0.1, 0.0, 0.2)), static=True))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "calibration.json")
    ...     save_static(file, tree)
    ...     [(sample.parent, sample.child) for sample in load_static(file)]
    [('base_link', 'laser')]
    """
    samples = _static_samples(source)
    lines = [
        json.dumps(
            {
                "parent": sample.parent,
                "child": sample.child,
                "xyz": sample.transform.translation,
                "quaternion": sample.transform.rotation,
                "authority": sample.authority,
            },
            ensure_ascii=False,
        )
        for sample in samples
    ]
    text = "[\n  " + ",\n  ".join(map(_escaped, lines)) + "\n]\n" if lines else "[]\n"
    Path(path).write_text(text, encoding="utf-8")


def _static_samples(source: HasTree | TransformTree | Iterable[TransformStamped]) -> list[TransformStamped]:
    tree = source if isinstance(source, TransformTree) else getattr(source, "tree", None)
    if isinstance(tree, TransformTree):
        edges = tree.edges()
        found = [tree.samples_around(edge.child, 0)[0] for edge in edges if edge.static]
        samples = [sample for sample in found if sample is not None]
        moving = [] if samples else [edge.child for edge in edges]
    elif isinstance(source, Iterable):
        samples = list(as_batch(source))
        moving = [sample.child for sample in samples if not sample.static]
    else:
        raise TypeError(f"expected a buffer, a tree or samples, not {source!r}")
    if moving:
        frames = list(dict.fromkeys(moving))
        named = ", ".join(map(repr, frames[:_NAMED]))
        more = f" and {len(frames) - _NAMED} more" if len(frames) > _NAMED else ""
        raise ValueError(f"only static transforms are saved, but these move: {named}{more}")
    return samples


def _escaped(line: str) -> str:
    # JSON escapes a letter beyond 16 bits as a surrogate pair, whose halves YAML would read as two letters.
    return "".join(c if c.isprintable() or ord(c) > 0xFFFF else f"\\u{ord(c):04x}" for c in line)


def load_static(path: str | os.PathLike[str], *, authority: str = "") -> list[TransformStamped]:
    """The static transforms of a file, in its order, with the stamp 0.

    The file is a list in YAML or JSON. Each entry has a ``parent`` and a ``child``; ``xyz`` in m; one of ``rpy`` (roll,
    pitch and yaw about fixed axes, in rad), ``rpy_deg`` (degrees) and ``quaternion`` (x, y, z, w); and an
    ``authority``. Only the names of the frames are required. An entry may also have the form of
    `TransformStamped.to_dict`, or the form of ``tfbus convert --static-to-yaml``, with ``translation`` and
    ``rotation``.

    Parameters
    ----------
    path : path
        A file of YAML, unless it ends in ``.json``.
    authority : str
        The sender of entries that name none.

    Raises
    ------
    RecordingError
        If the file is not such a list, has more than 64 MiB (4 MiB of YAML that is not JSON), or an entry is not valid;
        the message has its number. For a missing file, the error is a `FileNotFoundError` as well.
    ImportError
        If YAML beyond JSON needs the extra: ``pip install "tfbus[bag]"``.

    Examples
    --------
    >>> def publish_calibration(bus: Bus) -> None:
    ...     bus.publish(load_static("calibration.yaml", authority="calibration"))
    """
    file = Path(path)
    refused = partial(RecordingError, path=str(file), kind="file")
    try:
        with file.open("rb") as content:
            data = content.read(MAX_INDEX + 1)
        if len(data) > MAX_INDEX:
            raise ValueError(f"it has more than {MAX_INDEX:,} bytes, which is the bound")
        entries = _parse(data.decode())
    except FileNotFoundError:
        raise MissingRecordingError(path=str(file), kind="file") from None
    except OSError as error:
        raise refused(f"it cannot be read: {error.strerror or error}", reason="unreadable") from error
    except ValueError as error:
        raise refused(f"it is neither YAML nor JSON: {error}"[:_LONGEST], reason="foreign") from error
    if not isinstance(entries, list):
        raise refused("it is not a list of transforms, each with a parent and a child", reason="foreign")
    samples = []
    for number, entry in enumerate(entries, 1):
        try:
            samples.append(_sample(entry, authority))
        except (ValueError, TypeError, ArithmeticError, LookupError, RecursionError) as error:
            raise refused(f"transform {number}: {error}"[:_LONGEST], reason="damaged") from error
    return samples


def _parse(text: str) -> Any:
    with suppress(ValueError, RecursionError):
        return json.loads(text)
    if len(text) > MAX_METADATA:
        raise ValueError(f"it is no JSON, and YAML may have {MAX_METADATA:,} bytes")
    try:
        from ruamel.yaml import YAML
    except ImportError as error:
        raise ImportError(f"to read YAML, tfbus needs one more package: {pip_install('bag')}") from error
    try:
        return YAML(typ="safe", pure=True).load(text)
    # For damaged text, a parser of YAML raises more than its own errors; deep nesting is a `RecursionError`.
    except Exception as error:  # noqa: BLE001
        raise ValueError(str(error) or type(error).__name__) from None


def _sample(entry: Any, authority: str) -> TransformStamped:
    if not isinstance(entry, Mapping):
        raise ValueError(f"expected a parent, a child and numbers, not {reprlib.repr(entry)}")  # noqa: TRY004 - the file is wrong
    if "transform" in entry:
        sample = TransformStamped.from_dict(entry)
        return sample.replace(stamp=0, static=True, authority=sample.authority or authority)
    both = [name for name, same in _SAME.items() if name in entry and same in entry]
    if both:
        raise ValueError(f"{both[0]} and {_SAME[both[0]]} say the same: give one of them")
    entry = {_SAME.get(name, name): value for name, value in entry.items()}
    unknown = [str(name) for name in entry if name not in {"parent", "child", "authority", *_SIZES}]
    missing = [name for name in ("parent", "child") if name not in entry]
    if unknown or missing:
        raise ValueError(f"it has no {missing[0]!r}" if missing else f"it has an unknown {unknown[0]!r}")
    rotations = [name for name in _ROTATIONS if name in entry]
    if len(rotations) > 1:
        raise ValueError(f"{' and '.join(rotations)} say the same: give one of them")
    numbers = {name: _numbers(name, entry[name]) for name in _SIZES if name in entry}
    xyz = numbers.get("xyz", [0.0, 0.0, 0.0])
    if "quaternion" in numbers:
        transform = Transform(xyz, numbers["quaternion"])
    else:
        degrees = [math.radians(angle) for angle in numbers.get("rpy_deg", [0.0, 0.0, 0.0])]
        transform = Transform.from_xyz_rpy(xyz, numbers.get("rpy", degrees))
    sender = entry.get("authority") or authority
    try:
        return TransformStamped(entry["parent"], entry["child"], 0, transform, sender, static=True)
    except InvalidTransformError as error:
        raise ValueError(str(error)) from None


def _numbers(name: str, value: Any) -> list[float]:
    if not isinstance(value, Sequence) or len(value) != _SIZES[name] or not all(map(is_real, value)):
        raise ValueError(f"{name!r} is a list of {_SIZES[name]} numbers, not {reprlib.repr(value)}")
    return [float(number) for number in value]

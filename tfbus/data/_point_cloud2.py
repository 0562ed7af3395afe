"""Clouds as ``sensor_msgs/PointCloud2`` lays them out: rows of points, each with fields at their offsets."""

from base64 import b64decode
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data._message_fields import get
from tfbus.data.clouds import PointCloud

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""The constants of ``sensor_msgs/PointField``."""


def read_cloud(message: object, frame: str, stamp: int) -> PointCloud:
    """The cloud of a message; arrays are views of its data wherever its layout allows that.

    Raises
    ------
    ValueError
        If the layout does not fit the data, or has no x, y and z.
    """
    kind = _dtype(message)
    height, width = int(get(message, "height")), int(get(message, "width"))
    row_step = int(get(message, "row_step"))
    data = _bytes(get(message, "data"))
    if min(height, width) < 0 or row_step < width * kind.itemsize or height * row_step > data.size:
        raise ValueError(
            f"a cloud of {height} rows of {width} points of {kind.itemsize} bytes, {row_step} bytes a row, is not in"
            f" {data.size} bytes"
        )
    rows = np.ndarray((height, width), kind, data.data, 0, (row_step, kind.itemsize)) if data.size else None
    points: npt.NDArray[Any] = np.empty(0, kind) if rows is None else rows.reshape(-1)
    columns = {name: points[name] for name in kind.names or () if name not in ("x", "y", "z")}
    return PointCloud(frame, stamp, _coordinates(points), fields=columns)


def layout_of(cloud: PointCloud, like: object) -> tuple[dict[str, Any], bytes]:
    """The fields of a message for a cloud in the layout of another message, and its data."""
    kind = _dtype(like)
    rows = np.zeros(len(cloud), kind)
    for number, axis in enumerate("xyz"):
        rows[axis] = cloud.points[:, number]
    for name in kind.names or ():
        if name not in ("x", "y", "z"):
            if name not in cloud.fields:
                raise ValueError(f"the cloud has no field {name!r}, which the message to be like has")
            rows[name] = cloud.fields[name]
    big = bool(get(like, "is_bigendian"))
    return _counts(len(cloud), kind.itemsize, big), rows.tobytes()


def new_layout(cloud: PointCloud) -> dict[str, Any]:
    """All fields but the header of a message for a cloud, as a mapping: x, y, z, and then the others."""
    codes = {np.dtype(text): code for code, text in _KINDS.items()}
    named = [*((axis, cloud.points[:, number]) for number, axis in enumerate("xyz")), *cloud.fields.items()]
    columns = []
    for name, values in named:
        code = codes.get(values.dtype.newbyteorder("="))
        if code is None or values.ndim > 2:
            raise ValueError(f"a PointCloud2 cannot hold field {name!r} of dtype {values.dtype}, shape {values.shape}")
        columns.append((name, code, values.reshape(len(cloud), *(values.shape[1:] or (1,)))))
    kind = np.dtype([(name, f"<{_KINDS[code]}", (values.shape[1],)) for name, code, values in columns])
    rows = np.zeros(len(cloud), kind)
    fields = []
    for name, code, values in columns:
        rows[name] = values
        offset = _places(kind)[name][1]
        fields.append({"name": name, "offset": offset, "datatype": code, "count": values.shape[1]})
    counts = _counts(len(cloud), kind.itemsize, big=False)
    return {**counts, "fields": fields, "data": rows.tobytes()}


def _counts(size: int, point_step: int, big: bool) -> dict[str, Any]:
    step = {"point_step": point_step, "row_step": size * point_step}
    return {"height": 1, "width": size, "is_bigendian": big, **step, "is_dense": False}


def _dtype(message: object) -> np.dtype[Any]:
    order = ">" if get(message, "is_bigendian") else "<"
    names, formats, offsets = [], [], []
    for field in get(message, "fields"):
        name, code, count = get(field, "name"), int(get(field, "datatype")), int(get(field, "count"))
        if code not in _KINDS:
            raise ValueError(f"field {name!r} has the datatype {code}, which is none of PointField's")
        names.append(str(name))
        # Old drivers write 0 for one.
        formats.append((f"{order}{_KINDS[code]}", (count,)) if count > 1 else f"{order}{_KINDS[code]}")
        offsets.append(int(get(field, "offset")))
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"a cloud needs the fields x, y and z, this one has {', '.join(names) or 'none'}")
    step = int(get(message, "point_step"))
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def _bytes(data: Any) -> npt.NDArray[np.uint8]:
    """The data of a message without a copy, if it is in one piece; JSON has it in base64."""
    if isinstance(data, str):
        data = b64decode(data)
    if isinstance(data, (list, tuple)):
        data = bytes(data)
    return np.frombuffer(data, np.uint8)


def _coordinates(points: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """x, y and z of all points, shape (n, 3): a view if they lie side by side."""
    kind = points.dtype
    (x, at_x), (y, at_y), (z, at_z) = (_places(kind)[axis][:2] for axis in "xyz")
    if x.shape or y.shape or z.shape:
        raise ValueError("x, y and z must be one number each")
    if x == y == z and x.kind == "f" and at_y - at_x == at_z - at_y == x.itemsize and len(points):
        return np.ndarray((len(points), 3), x, points.data, at_x, (points.strides[0], x.itemsize))
    return np.stack([points[axis] for axis in "xyz"], axis=-1)


def _places(kind: np.dtype[Any]) -> Mapping[str, Any]:
    """The type and the offset of each field."""
    return {} if kind.fields is None else kind.fields

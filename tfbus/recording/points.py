"""`load_points`, the clouds and scans on a topic of a recording, thinned so that they fit in memory."""

import os
from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np

from tfbus.data import LaserScan, PointCloud
from tfbus.data.messages import from_message
from tfbus.errors import RecordingError
from tfbus.recording.formats.copies import MessageTypes
from tfbus.recording.formats.storage import Channel, UnfoldError
from tfbus.recording.formats.transforms import decompressed
from tfbus.recording.recording import open_storage

_TYPES: Final = ("sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan")
MAX_POINTS: Final = 10_000_000
"""Of a topic: 120 MB."""


def load_points(
    path: str | os.PathLike[str], topic: str, *, most: int = 20_000, problems: Counter[str] | None = None
) -> list[PointCloud]:
    """Read the clouds and scans on a topic of a recording, each in its frame and with its stamp.

    Parameters
    ----------
    path : str or path-like
        As `open_recording`.
    topic : str
        A topic of ``sensor_msgs/PointCloud2`` or ``sensor_msgs/LaserScan``.
    most : int
        Of a cloud with more points, every second, third … is kept. All clouds together keep at most 10,000,000 points;
        where they have more, this number is halved until they fit.
    problems : Counter, optional
        Gets the number of messages that were left out: ``"damaged"``.

    Returns
    -------
    list of PointCloud
        Finite points in float32, without other fields, in the order of their stamps.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or nothing of that type is on the topic.
    ValueError
        If `most` is less than one.

    Examples
    --------
    >>> from tfbus.recording import load_points
    >>> try:
    ...     clouds = load_points("small.bag", "/scan")
    ... except RecordingError as error:
    ...     print(error.reason)
    no such topic
    """
    if most < 1:
        raise ValueError(f"at least one point of a cloud is kept, got most={most!r}")
    name = topic.removeprefix("/")
    types = MessageTypes()
    clouds: list[PointCloud] = []
    total = damaged = 0
    storage = open_storage(Path(path))
    try:
        for _, channel, payload in storage.messages(
            lambda each: each.topic.removeprefix("/") == name and _has_points(each)
        ):
            try:
                cloud = _read(types, channel, payload, most)
            except (ValueError, TypeError):
                damaged += 1
                continue
            clouds.append(cloud)
            total += len(cloud)
            while total > MAX_POINTS and most > 1:
                most //= 2
                clouds = [_thinned(each, most) for each in clouds]
                total = sum(map(len, clouds))
        there = sorted({channel.topic for channel in storage.channels if _has_points(channel)})
    finally:
        storage.close()
    if not clouds:
        problem = f"no clouds or scans are on topic {topic!r}; topics with them: {', '.join(there) or 'none'}"
        raise RecordingError(problem, path=os.fspath(path), reason="no such topic")
    if damaged and problems is not None:
        problems["damaged"] += damaged
    return sorted(clouds, key=lambda each: each.stamp)  # type: ignore[arg-type, return-value]


def _has_points(channel: Channel) -> bool:
    is_ros = channel.encoding in ("cdr", "ros1") and "/" in channel.type
    return is_ros and MessageTypes.name(channel.type) in _TYPES


def _read(types: MessageTypes, channel: object, payload: bytes, most: int) -> PointCloud:
    if not isinstance(channel, Channel):
        raise ValueError("this part of the file is lost")  # noqa: TRY004 - the file is wrong
    try:
        data = from_message(types.read(channel, decompressed(channel, payload)))
    except UnfoldError as error:
        raise ValueError(str(error)) from None
    return _thinned(data.to_points() if isinstance(data, LaserScan) else data, most)


def _thinned(cloud: PointCloud, most: int) -> PointCloud:
    points = cloud.points[:: -(-len(cloud) // most) or 1]
    # A copy, which does not keep all points in memory.
    return PointCloud(cloud.frame, cloud.stamp, points[np.isfinite(points).all(axis=1)].astype(np.float32))

"""Messages with the positions of joints, by `rosbags`."""

from collections.abc import Sequence

import numpy as np
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_HUMBLE)
KIND = "sensor_msgs/msg/JointState"


def joint_state(
    stamp: int, positions: dict[str, float], more_names: Sequence[str] = (), little_endian: bool = True
) -> bytes:
    """The message in CDR, by `rosbags`; `more_names` have no positions."""
    kinds = TYPES.types
    header = kinds["std_msgs/msg/Header"](
        stamp=kinds["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9), frame_id="x"
    )
    none = np.array([])
    message = kinds[KIND](header, [*positions, *more_names], np.array(list(positions.values())), none, none)
    return bytes(TYPES.serialize_cdr(message, KIND, little_endian=little_endian))

from typing import Any

import numpy as np
import pytest

from tfbus import PointCloud
from tfbus.data.messages import layout_of, new_layout, read_cloud


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_layout_can_be_written_and_read_in_either_byte_order(dtype: type) -> None:
    cloud = PointCloud("a", 5, np.arange(12, dtype=dtype).reshape(4, 3), fields={"i": np.arange(4, dtype=np.uint16)})
    message = new_layout(cloud)
    for big in (False, True):
        like = {**message, "is_bigendian": big}
        counts, data = layout_of(cloud, like)
        again = read_cloud({**like, **counts, "data": data}, "b", 6)
        assert (again.frame, again.stamp, counts["is_bigendian"]) == ("b", 6, big)
        assert again.points.tolist() == cloud.points.tolist()
        assert again.fields["i"].tolist() == [0, 1, 2, 3]


def test_every_datatype_of_a_field_is_read() -> None:
    # The constants of sensor_msgs/PointField: INT8 is 1, and so on up to FLOAT64.
    kinds: list[Any] = [np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.float32, np.float64]
    for datatype, kind in enumerate(kinds, 1):
        message = new_layout(PointCloud("a", 5, np.zeros((1, 3), np.float32)))
        value = np.array([100], kind)
        message["fields"].append({"name": "v", "offset": 12, "datatype": datatype, "count": 1})
        step = 12 + value.itemsize
        message.update(point_step=step, row_step=step, height=1, width=1, data=bytes(12) + value.tobytes())
        found = read_cloud(message, "a", 5).fields["v"]
        assert (found.dtype, found.tolist()) == (value.dtype, [100])


@pytest.mark.parametrize(("first", "places", "is_view"), [(4, "xyz", True), (0, "xyz", True), (4, "zyx", False)])
def test_coordinates_side_by_side_anywhere_in_a_point_are_a_view(first: int, places: str, is_view: bool) -> None:
    message = new_layout(PointCloud("a", 5, np.array([(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)], np.float32)))
    for field in message["fields"]:
        field["offset"] = first + 4 * places.index(field["name"])
    rows = np.zeros((2, 5), np.float32)
    for number, axis in enumerate("xyz"):
        rows[:, first // 4 + places.index(axis)] = (number + 1, number + 4)
    data = rows.tobytes()
    message.update(point_step=20, row_step=40, data=data)
    points = read_cloud(message, "a", 5).points
    assert points.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert np.shares_memory(points, np.frombuffer(data, np.uint8)) == is_view


def test_a_field_may_have_several_numbers_for_each_point_in_one_row() -> None:
    pairs = np.arange(4, dtype=">u2").reshape(2, 2)
    message = new_layout(PointCloud("a", 5, np.zeros((2, 3), np.float32), fields={"pair": pairs}))
    assert message["fields"][-1] == {"name": "pair", "offset": 12, "datatype": 4, "count": 2}
    assert (message["point_step"], message["row_step"], message["is_bigendian"], message["is_dense"]) == (
        16,
        32,
        False,
        False,
    )
    assert read_cloud(message, "a", 5).fields["pair"].tolist() == [[0, 1], [2, 3]]
    with pytest.raises(ValueError, match=r"field 'grid' of dtype uint8, shape \(2, 1, 1\)"):
        new_layout(PointCloud("a", 5, np.zeros((2, 3)), fields={"grid": np.zeros((2, 1, 1), np.uint8)}))


def test_an_empty_cloud_has_the_layout_of_a_full_one() -> None:
    def fields_of(count: int) -> object:
        fields: dict[str, Any] = {"pair": np.zeros((count, 2), np.uint16), "index": np.zeros(count, np.int32)}
        return new_layout(PointCloud("a", 5, np.zeros((count, 3), np.float32), fields=fields))["fields"]

    assert fields_of(0) == fields_of(3)


def test_a_coordinate_is_one_number() -> None:
    message = new_layout(PointCloud("a", 5, np.ones((1, 3))))
    message["fields"][0]["count"] = 3
    with pytest.raises(ValueError, match="one number each"):
        read_cloud(message, "a", 5)

from support.samples import moving, static

from tfbus import SECOND
from tfbus.plot.plots import read_reception
from tfbus.recording import RecordedMessage


def test_each_frame_has_its_stamps_and_the_times_of_their_arrival() -> None:
    messages = [
        RecordedMessage(5 * SECOND, (moving("map", "b", 4 * SECOND), static("b", "lidar")), ()),
        RecordedMessage(7 * SECOND, (moving("map", "b", 6 * SECOND), moving("map", "a", 7 * SECOND)), ()),
        RecordedMessage(8 * SECOND, (moving("map", "b", 6 * SECOND),), ()),
    ]
    reception = read_reception(messages)
    assert list(reception) == ["a", "b", "lidar"]
    assert reception["b"].stamps.tolist() == [4 * SECOND, 6 * SECOND, 6 * SECOND]
    assert reception["b"].received.tolist() == [5 * SECOND, 7 * SECOND, 8 * SECOND]
    assert reception["b"].periods.tolist() == [2.0]
    assert reception["b"].delays.tolist() == [1.0, 1.0, 2.0]
    assert [reception[frame].static for frame in ("a", "b", "lidar")] == [False, False, True]
    assert reception["lidar"].periods.tolist() == reception["lidar"].delays.tolist() == []

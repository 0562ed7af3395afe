import json
from dataclasses import FrozenInstanceError, asdict, fields
from typing import Any

import pytest

from tfbus.statistics import (
    BufferServerStatistics,
    BufferStatistics,
    BusStatistics,
    LinkStatistics,
    QueueStatistics,
    RecorderStatistics,
    RobotStatistics,
)

BUFFER = BufferStatistics(offered=9, inserted=3, replaced=2, expired=4, waiting=5, expired_ahead=2, superseded=1)
QUEUE = QueueStatistics("stream", "conflate", capacity=5, pending=4, dropped=3)
ONE_OF_EACH: list[Any] = [
    BUFFER,
    QUEUE,
    BusStatistics(1, {"cycle": 2}, 3, 4, 5, 6, 7, 8, (BUFFER,), (QUEUE,)),
    LinkStatistics(1, 2, 3, 4, 5, 6, 7, {"frame name": 8}, {"damaged": 9}, QUEUE),
    BufferServerStatistics(1, 2, 3, 4, {"busy": 5}, QUEUE),
    RecorderStatistics(1, 2, 3, {"stamp": 4}, QUEUE),
    RobotStatistics(1, 2, {"elbow": 3}),
]


@pytest.mark.parametrize("statistics", ONE_OF_EACH, ids=lambda statistics: type(statistics).__name__)
def test_statistics_are_frozen_and_serializable_as_json(statistics: Any) -> None:
    names = [field.name for field in fields(statistics)]
    with pytest.raises(FrozenInstanceError):
        setattr(statistics, names[0], 0)
    assert not hasattr(statistics, "__dict__")
    assert list(json.loads(json.dumps(asdict(statistics)))) == names


def test_the_json_of_a_bus_has_its_buffers_and_queues_by_name() -> None:
    described = json.loads(json.dumps(asdict(ONE_OF_EACH[2])))
    assert described["rejected"] == {"cycle": 2}
    assert described["ahead"] == 0
    assert described["buffers"] == [
        {
            "offered": 9,
            "inserted": 3,
            "replaced": 2,
            "expired": 4,
            "waiting": 5,
            "expired_ahead": 2,
            "superseded": 1,
            "looped": 0,
        }
    ]
    assert BufferStatistics(1, 1, 0, 0, 0) == BufferStatistics(1, 1, 0, 0, 0, expired_ahead=0, superseded=0, looped=0)
    assert described["queues"] == [
        {"kind": "stream", "overflow": "conflate", "capacity": 5, "pending": 4, "dropped": 3, "conflated": 0}
    ]


@pytest.mark.parametrize("statistics", ONE_OF_EACH, ids=lambda statistics: type(statistics).__name__)
def test_statistics_are_plain_data_and_come_back(statistics: Any) -> None:
    data = json.loads(json.dumps(statistics.to_dict()))
    assert data["type"] == type(statistics).__name__
    assert type(statistics).from_dict(data) == statistics

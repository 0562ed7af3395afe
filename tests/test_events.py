"""The texts and the plain data of events and statistics."""

import json
import pickle
from typing import Any, get_args

import pytest

from tfbus import (
    SECOND,
    AuthorityConflict,
    ClockOffset,
    ClockReset,
    Event,
    FrameAdded,
    FrameLive,
    FrameRemoved,
    FrameStale,
    InvalidTransformError,
    KindChanged,
    PastLoop,
    PeerClockStepped,
    PeerJoined,
    PeerLost,
    PeerRejected,
    RecordingDropped,
    RecordingFailed,
    Reparented,
    SampleRejected,
    StampAhead,
    StampBehind,
    SubscriberFailed,
)
from tfbus.statistics import (
    BufferServerStatistics,
    BufferStatistics,
    BusStatistics,
    LinkStatistics,
    QueueStatistics,
    RecorderStatistics,
    RobotStatistics,
)

AT = 12 * SECOND + 500_000_000
ONE_OF_EACH: list[tuple[Event, str]] = [
    (FrameAdded(AT, "tool", "arm", "cell", static=False), "moving frame 'tool' is new under 'arm', from 'cell'"),
    (FrameAdded(AT, "tool", "arm", "", static=True), "static frame 'tool' is new under 'arm', from ''"),
    (FrameRemoved(AT, "tool"), "frame 'tool' was removed"),
    (Reparented(AT, "cup", "hand", "table", "cell"), "frame 'cup' moves from 'table' to 'hand', says 'cell'"),
    (KindChanged(AT, "cup", static=True, authority="cell"), "frame 'cup' is now static, says 'cell'"),
    (KindChanged(AT, "cup", static=False, authority="cell"), "frame 'cup' is now moving, says 'cell'"),
    (
        AuthorityConflict(AT, "odom", "slam", "odometry"),
        "frame 'odom' comes from two authorities, 'slam' and 'odometry'",
    ),
    (
        PastLoop(AT, "cup", "hand", "cell", 10 * SECOND, ("cup", "hand", "cup")),
        "the frames cup -> hand -> cup form a loop at 10.000 s, with late data of 'cell'",
    ),
    (
        SampleRejected(AT, "cycle", "a", "b", "rogue", InvalidTransformError("no\nloops", reason="cycle")),
        "a sample from 'rogue' was rejected: no\\nloops",
    ),
    (
        SampleRejected(AT, "not a sample", None, None, None, TypeError("what is 7?")),
        "a sample was rejected: what is 7?",
    ),
    (
        FrameStale(AT, "base", 12 * SECOND, "odometry"),
        "frame 'base' is stale, its newest sample from 'odometry' is 500 ms old",
    ),
    (FrameLive(AT, "base", AT, "odometry"), "frame 'base' is live again, from 'odometry'"),
    (
        StampAhead(AT, "base", AT + 3600 * SECOND, "peer"),
        "frame 'base' has a sample 3600 s ahead of the clock, from 'peer'",
    ),
    (
        StampBehind(AT, "base", 12, None, "peer"),
        "frame 'base' has a sample 12.5 s behind the clock, from 'peer': seconds passed as nanoseconds?",
    ),
    (
        StampBehind(AT, "base", 0, 11 * SECOND, "peer"),
        "frame 'base' has a sample 11 s older than the newest, and has expired, from 'peer'",
    ),
    (ClockReset(AT, 90 * SECOND), "the clock jumped back from 90.000 s"),
    (SubscriberFailed(AT, "print", OSError("full")), "the subscriber print raised OSError('full')"),
    (PeerJoined(AT, "tf", "5eed"), "peer 5eed has joined tf"),
    (
        PeerLost(AT, "tf", "5eed", ("arm", "slam"), ("odom", "tool")),
        "peer 5eed is lost on tf, who spoke for 'arm', 'slam': 2 frames",
    ),
    (PeerLost(AT, "tf", "5eed", (), ()), "peer 5eed is lost on tf: 0 frames"),
    (
        PeerRejected(AT, "tf", "5eed", "truncated", ValueError("ends\nearly")),
        "peer 5eed on tf sent data that were refused: ends\\nearly",
    ),
    (
        ClockOffset(AT, "tf", "5eed", ("arm", "slam"), 0.31, 0.0002),
        "'arm', 'slam' runs 310 ms ahead of this clock, within 200 us: peer 5eed on tf",
    ),
    (
        ClockOffset(AT, "tf", "5eed", (), -0.01, 0.0002, over=True),
        "peer 5eed runs 10 ms behind this clock, within 200 us: on tf, which is near enough",
    ),
    (
        PeerClockStepped(AT, "tf", "5eed", -1.0, ("odom", "tool")),
        "a clock behind peer 5eed on tf was set back by 1 s: its frames begin anew, 'odom', 'tool'",
    ),
    (RecordingDropped(AT, "run.mcap", 7), "the recording run.mcap is behind and loses samples, 7 so far"),
    (RecordingFailed(AT, "run.mcap", OSError("disk\nfull")), "the recording run.mcap has ended early: disk\\nfull"),
]


def test_the_examples_of_this_file_have_every_event() -> None:
    assert {type(event) for event, _ in ONE_OF_EACH} == set(get_args(Event))


@pytest.mark.parametrize(("event", "text"), ONE_OF_EACH)
def test_events_are_values_with_a_text_of_one_line(event: Event, text: str) -> None:
    assert str(pickle.loads(pickle.dumps(event))) == f"12.500 s: {text}"
    assert len({event, event}) == 1


def test_two_rejections_for_the_same_reason_are_equal_whatever_their_errors() -> None:
    first, second = (SampleRejected(AT, "cycle", "a", "b", "rogue", ValueError(text)) for text in ("one", "two"))
    assert first == second


@pytest.mark.parametrize("event", [event for event, _ in ONE_OF_EACH])
def test_an_event_is_plain_data_and_comes_back(event: Event) -> None:
    data = json.loads(json.dumps(event.to_dict()))
    assert data["type"] == type(event).__name__
    back = type(event).from_dict(data)
    if isinstance(event, SubscriberFailed):
        # An error that is none of tfbus comes back as its text.
        assert repr(back.error) == "Exception('OSError: full')"  # type: ignore[union-attr]
    else:
        assert back == event
    if isinstance(event, SampleRejected) and isinstance(event.error, InvalidTransformError):
        assert (repr(back.error), str(back)) == (repr(event.error), str(event))  # type: ignore[union-attr]


BUFFER = BufferStatistics(offered=9, inserted=3, replaced=2, expired=4, waiting=5, expired_ahead=2, superseded=1)
QUEUE = QueueStatistics("stream", "conflate", capacity=5, pending=4, dropped=3)
STATISTICS: list[Any] = [
    BUFFER,
    QUEUE,
    BusStatistics(1, {"cycle": 2}, 3, 4, 5, 6, 7, 8, (BUFFER,), (QUEUE,)),
    LinkStatistics(1, 2, 3, 4, 5, 6, 7, {"frame name": 8}, {"damaged": 9}, QUEUE),
    BufferServerStatistics(1, 2, 3, 4, {"busy": 5}),
    RecorderStatistics(1, 2, 3, {"stamp": 4}, QUEUE),
    RobotStatistics(1, 2, {"elbow": 3}),
]


@pytest.mark.parametrize("statistics", STATISTICS, ids=lambda statistics: type(statistics).__name__)
def test_statistics_are_plain_data_and_come_back(statistics: Any) -> None:
    data = json.loads(json.dumps(statistics.to_dict()))
    assert data["type"] == type(statistics).__name__
    assert type(statistics).from_dict(data) == statistics

"""The numbers of a recording, and the suspicions about it."""

import dataclasses
import pickle
import struct
from array import array
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.processes import peak_of
from support.recorded import SMALL, WRONG_IN_SMALL, Line, messages_in, real, write_blocks, write_mcap, write_recording
from support.samples import any_samples, moving, static

from tfbus import SECOND, TransformStamped
from tfbus.recording import FrameSummary, RecordedMessage, RecordingSummary, examine, load, open_recording, summarise
from tfbus.recording.summary import Durations, Periods
from tfbus.stamps import STAMP_MAX, STAMP_MIN
from tfbus.tf_message import encode

MS = 1_000_000


def summary_of(path: Path) -> RecordingSummary:
    with open_recording(path) as recording:
        return summarise(recording)


def sent(samples: Sequence[TransformStamped]) -> list[Line]:
    """A message for each sample."""
    return [(time, "/tf_static" if sample.static else "/tf", [sample]) for time, sample in enumerate(samples)]


def frame_in(path: Path, samples: Sequence[TransformStamped]) -> FrameSummary:
    """The summary of the only frame in a recording."""
    (frame,) = summary_of(write_mcap(path / "run.mcap", sent(samples))).frames
    return frame


def test_the_small_bag_has_what_its_script_sends() -> None:
    summary = summary_of(SMALL)
    frames = {frame.frame: frame for frame in summary.frames}
    assert [*frames] == sorted(frames)
    # From a second before the start to 2 ms after the last stamp of the odometry.
    assert (summary.start, summary.end, summary.duration) == (99 * SECOND, 109_982 * MS, 10.982)
    assert summary.roots == ("hen", "island", "map")
    assert summary.problems == WRONG_IN_SMALL
    assert summary.finished
    # 10 Hz for 10 s.
    odom = frames["odom"]
    assert dataclasses.replace(odom, period=None, delay=None) == FrameSummary(
        "odom", ("map",), 0, 100, 100 * SECOND, 109_900 * MS, 10.0, 0.1, ("slam",)
    )
    # 50 Hz for 4 s, then from 5.5 s to 10 s, and one that came late.
    base = frames["base_link"]
    assert (base.moving, base.span, base.longest_gap) == (200 + 225 + 1, 9.98, 1.52)
    assert base.rate == pytest.approx(425 / 9.98)
    assert frames["box"].parents == ("table", "gripper")
    assert frames["laser"] == FrameSummary("laser", ("base_link",), 1, 0, None, None, None, None, ("calibration",))
    # Static ones, 10 + 20 + 20 + 5 Hz for 10 s, the base, the good ones beside bad ones, the first half of a loop.
    assert summary.transforms == 5 + 100 + 200 + 200 + 50 + 426 + 10 + 1
    assert summary.messages == len(messages_in(SMALL))


def test_a_single_moving_sample_has_no_rate(tmp_path: Path) -> None:
    frame = frame_in(tmp_path, [moving("a", "b", 7)])
    assert (frame.oldest, frame.newest, frame.span, frame.rate, frame.longest_gap) == (7, 7, 0.0, None, None)
    assert frame.kind == "moving"


def test_stamps_that_are_centuries_apart_are_summarised() -> None:
    messages = [
        RecordedMessage(received, (moving("map", "base", stamp),), ())
        for received, stamp in ((STAMP_MAX, STAMP_MIN), (0, 0), (0, STAMP_MAX))
    ]
    with open_recording(SMALL) as recording:
        (frame,) = summarise(recording, messages).frames
    assert (frame.moving, frame.oldest, frame.newest) == (3, STAMP_MIN, STAMP_MAX)
    assert frame.period is not None
    assert frame.delay is not None
    # Half of 2^64 - 1 ns; the longest time that is told is 2^63 - 1 ns.
    assert frame.period.mean == pytest.approx(9.223372036854775e9)
    assert frame.longest_gap == pytest.approx(9.223372036854775e9)
    assert frame.delay.max == pytest.approx(9.223372036854775e9)


def test_order_and_repetition_of_stamps_change_neither_gap_nor_rate(tmp_path: Path) -> None:
    frame = frame_in(tmp_path, [moving("a", "b", stamp * SECOND) for stamp in (0, 3, 1, 2, 2, 2, 4)])
    assert (frame.moving, frame.rate, frame.longest_gap, frame.span) == (7, 1.0, 1.0, 4.0)


def test_a_frame_with_static_and_moving_samples_has_both_kinds(tmp_path: Path) -> None:
    frame = frame_in(tmp_path, [static("a", "b"), moving("c", "b", 5), moving("a", "b", 6)])
    assert (frame.kind, frame.static, frame.moving, frame.parents) == ("both", 1, 2, ("a", "c"))


@pytest.mark.parametrize("kinds", ["ms", "sm", "ss", "mm", "mss", "smm"])
def test_samples_of_each_kind_are_counted_in_whatever_block_they_come(path: Path, kinds: str) -> None:
    samples = [static("a", "b") if kind == "s" else moving("a", "b", at) for at, kind in enumerate(kinds)]
    frames = {each.frame: each for each in summary_of(write_blocks(path, sent(samples))).frames}
    assert (frames["b"].static, frames["b"].moving) == (kinds.count("s"), kinds.count("m"))


def test_the_summary_shows_an_unfinished_and_damaged_file(tmp_path: Path) -> None:
    lines = [(time, "/tf", [moving("a", "b", time, 0.5 + time)]) for time in range(100)]
    path = write_mcap(tmp_path / "run.mcap", lines, finish=False)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    summary = summary_of(path)
    assert not summary.finished
    assert summary.problems == {"damaged": 1, "unfinished": 1}
    assert 50 < summary.transforms < 100


@given(batches=st.lists(st.lists(any_samples("abcd", last=20), max_size=4), max_size=12))
def test_the_samples_left_out_are_those_left_out_of_a_loaded_tree(
    tmp_path_factory: pytest.TempPathFactory, batches: list[list[TransformStamped]]
) -> None:
    lines = [
        (time, "/tf_static" if kind else "/tf", chosen)
        for time, samples in enumerate(batches)
        for kind in (True, False)
        if (chosen := [sample for sample in samples if sample.static == kind])
    ]
    path = write_mcap(tmp_path_factory.mktemp("recording") / "run.mcap", lines)
    summary = summary_of(path)
    problems: Counter[str] = Counter()
    tree = load(path, problems=problems)
    assert summary.problems == problems
    sent = sum(len(samples) for _, _, samples in lines)
    assert summary.transforms == sent - sum(problems.values()) == tree.inserted + tree.replaced
    assert {frame.frame for frame in summary.frames} == {edge.child for edge in tree.edges()}
    for frame, edge in zip(summary.frames, tree.edges(), strict=True):
        assert edge.parent in frame.parents


@pytest.mark.parametrize(
    ("lines", "loops"),
    [
        # Of one stamp, the parent that comes later holds.
        ([moving("a", "b", 5), moving("c", "b", 5), moving("b", "c", 6)], 1),
        ([moving("c", "b", 5), moving("a", "b", 5), moving("b", "c", 6)], 0),
        ([moving("a", "b", 5), moving("c", "b", 4), moving("b", "c", 6)], 0),
        # Also where the stamps before are counted in columns.
        ([moving("a", "b", 5), moving("a", "b", 7), moving("c", "b", 6), moving("b", "c", 8)], 0),
        ([moving("a", "b", 5), moving("a", "b", 7), moving("a", "b", 3), moving("c", "b", 6), moving("b", "c", 8)], 0),
        ([moving("a", "b", 5), moving("a", "b", 7), moving("c", "b", 7), moving("b", "c", 8)], 1),
        ([static("a", "b"), moving("c", "b", 1), moving("b", "c", 2)], 1),
        ([moving("a", "b", 9), static("c", "b"), moving("b", "c", 2)], 1),
    ],
)
def test_the_newest_parent_of_a_frame_decides_what_closes_a_loop(
    tmp_path: Path, lines: list[TransformStamped], loops: int
) -> None:
    path = write_blocks(tmp_path / "run.mcap", sent(lines))
    counted: list[int] = []
    with open_recording(path) as recording:
        summary = summarise(recording, progress=counted.append)
    problems: Counter[str] = Counter()
    load(path, problems=problems)
    assert summary.problems == problems == ({"cycle": loops} if loops else {})
    assert counted == [1] * len(lines)
    assert summary.messages == len(lines)


def test_a_summary_is_a_value(path: Path) -> None:
    summary = summary_of(SMALL)
    assert pickle.loads(pickle.dumps(summary)) == summary
    assert summary_of(write_mcap(path, [])) == RecordingSummary(path, True, None, None, 0, 0, (), (), {})


def test_a_duration_or_a_span_needs_both_ends() -> None:
    frame = FrameSummary("b", ("a",), 0, 0, None, None, None, None, ())
    whole = RecordingSummary(Path("run"), True, None, None, 0, 0, (frame,), ("a",), {})
    for first, last, expected in ((None, None, None), (SECOND, None, None), (None, SECOND, None), (0, SECOND, 1.0)):
        assert dataclasses.replace(whole, start=first, end=last).duration == expected
        assert dataclasses.replace(frame, oldest=first, newest=last).span == expected


def test_the_summary_of_a_real_robot() -> None:
    summary = summary_of(real("pr2_tf.bag"))
    assert len(summary.frames) == 82
    assert summary.roots == ("base_footprint",)
    assert summary.problems == {}
    # 153 messages on /tf, and one on /tf_static.
    assert summary.messages == 154
    assert {frame.moving for frame in summary.frames if frame.moving} == {153}


def test_a_long_recording_is_summarised_in_blocks_as_message_by_message(path: Path) -> None:
    # 4,000 samples at 100 Hz, each received 3 ms after its stamp, but for the last: 5 ms, from another sender.
    lines = [(10 * MS * k + 3 * MS, moving("a", "b", 10 * MS * k, float(k), "one")) for k in range(3_999)]
    lines.append((39_990 * MS + 5 * MS, moving("a", "b", 39_990 * MS, 0.0, "two")))
    # A late sample of another parent leaves the newest edge as it is, so the next one closes no loop.
    lines.append((40_000 * MS, moving("c", "b", 39_985 * MS, 0.0, "one")))
    lines.append((40_001 * MS, moving("b", "c", 40_001 * MS, 0.0, "three")))
    write_recording(path, *((received, (sample,)) for received, sample in lines))
    counted: list[int] = []
    with open_recording(path) as recording:
        summary = summarise(recording, progress=counted.append)
        one_by_one = summarise(recording, recording.messages())
    # The first one names the frame, the last one has to be judged.
    assert len(counted) > 2
    assert sum(counted) == summary.messages == summary.transforms == 4_002
    assert summary.problems == {}
    assert summary.frames == one_by_one.frames
    frames = {frame.frame: frame for frame in summary.frames}
    b = frames["b"]
    assert (b.moving, b.oldest, b.newest, b.authorities) == (4_001, 0, 39_990 * MS, ("one", "two"))
    assert b.delay is not None
    # 3,999 of 3 ms, one of 5 ms and one of 15 ms.
    assert b.delay.mean == pytest.approx((3_999 * 0.003 + 0.005 + 0.015) / 4_001)
    assert b.delay.max == 0.015
    senders = {sender.authority: (sender.frames, sender.moving) for sender in summary.senders}
    assert senders == {"one": (("b",), 4_000), "two": (("b",), 1), "three": (("c",), 1)}


delays = st.lists(st.integers(-(10**15), 10**15), min_size=1, max_size=300)


@example(parts=[[1] * 98, [2, 3]], singles=[])
@example(parts=[[10**9] * 197 + [10**11] * 3], singles=[])
@example(parts=[[7 * k for k in range(size)] for size in (999, 1_000, 1_001, 2_500)], singles=[])
@example(parts=[[5]], singles=[7 * k for k in range(2_500)])
@given(parts=st.lists(delays, min_size=1, max_size=3), singles=st.lists(st.integers(-(10**15), 10**15), max_size=3))
def test_mean_and_maximum_are_exact_and_the_quantile_is_within_1_percent(
    parts: list[list[int]], singles: list[int]
) -> None:
    counted = []
    for part in parts:
        each = Durations()
        each.add(np.array(part))
        for duration in singles:
            each.add_one(duration)
        part += singles
        counted.append(each)
    spread = Durations.joined(counted).spread()
    assert spread is not None
    whole = sorted(delay for part in parts for delay in part)
    assert spread.mean == pytest.approx(sum(whole) / len(whole) / SECOND, rel=1e-9, abs=1e-9)
    assert spread.max == whole[-1] / SECOND
    exact = whole[-(-99 * len(whole) // 100) - 1] / SECOND
    assert spread.p99 == pytest.approx(exact, rel=0.0101, abs=1e-12)
    assert spread.p99 <= spread.max
    assert Durations().spread() is None


@pytest.mark.parametrize("at_once", [1, 999])
def test_durations_that_come_in_few_take_no_more_memory_the_more_there_are(at_once: int) -> None:
    durations = Durations()

    def count() -> None:
        for _ in range(30_000 // at_once):
            if at_once == 1:
                durations.add_one(7)
            else:
                durations.add(np.full(at_once, 7))

    # Half of what they would take, at 8 bytes each.
    assert peak_of(count) < 30_000 * 8 / 2


columns = st.lists(st.lists(st.integers(0, 10**4), max_size=60), max_size=4)


@given(columns=columns)
@example(columns=[])
@example(columns=[[*range(60_000)], [*range(30_000, 130_000)]])
@example(columns=[[5], [], [5, 5]])
@example(columns=[[5], [7, 7]])
@example(columns=[[9, 3, 6], [0, 3, 1]])
@example(columns=[[3, 0], [9, 12, 10]])
def test_the_periods_are_those_of_all_different_stamps(columns: list[list[int]]) -> None:
    periods = Periods([array("q", [stamp * SECOND for stamp in column]) for column in columns])
    stamps = sorted({stamp for column in columns for stamp in column})
    differences = np.diff(stamps)
    assert periods.oldest == (stamps[0] * SECOND if stamps else None)
    assert periods.newest == (stamps[-1] * SECOND if stamps else None)
    spread = periods.spread()
    if len(stamps) < 2:
        assert (periods.rate, periods.longest, spread) == (None, None, None)
        return
    assert spread is not None
    assert periods.rate == pytest.approx(1 / differences.mean())
    assert periods.longest == spread.max == differences.max()
    assert spread.mean == pytest.approx(differences.mean(), rel=1e-12)
    assert spread.p99 == pytest.approx(sorted(differences)[-(-99 * len(differences) // 100) - 1], rel=0.0101)


def test_a_recording_is_examined_as_it_arrived_with_the_norms_as_they_were_sent(path: Path) -> None:
    uneven = bytearray(encode([moving("odom", "base", 3 * SECOND)]))
    uneven[-8:] = struct.pack("<d", 1.005)
    lines: list[Line] = [
        *((k * SECOND, "/tf", [moving("odom", "base", k * SECOND)]) for k in range(3)),
        (3 * SECOND, "/tf", bytes(uneven)),
        (4 * SECOND, "/tf", [moving("odom", "base", 2 * SECOND)]),
        (5 * SECOND, "/tf", b"nonsense"),
    ]
    blocks: list[int] = []
    with open_recording(write_mcap(path, lines)) as recording:
        found = [
            (each.kind, each.frame, each.count, each.first, each.worst)
            for each in examine(recording, progress=blocks.append)
        ]
        late = [each.kind for each in examine(recording, since=4 * SECOND, until=4 * SECOND)]
    assert found[0][:3] == ("refused", None, 1)
    assert [each[:4] for each in found[1:3]] == [
        ("stamps go back", "base", 1, 2 * SECOND),
        ("duplicate stamps", "base", 1, 2 * SECOND),
    ]
    kind, _, count, first, worst = found[3]
    assert (kind, count, first) == ("rotation", 1, 3 * SECOND)
    assert worst is not None
    assert abs(worst - 0.005) < 1e-12
    assert (sum(blocks), late) == (6, [])

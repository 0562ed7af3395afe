from collections.abc import Sequence

import pytest

from tfbus.cli._table import Column, table_lines
from tfbus.cli.commands import compare, info, monitor, robot

COLUMNS = (Column("name"), Column("least", importance=1), Column("count", right=True, importance=2))
ROWS = [("a", "xyz", "1"), ("long name", "w", "1,000")]


def test_columns_are_as_wide_as_their_cells_and_numbers_stand_at_the_right() -> None:
    assert list(table_lines(COLUMNS, ROWS, None)) == [
        "name       least  count",
        "a          xyz        1",
        "long name  w      1,000",
    ]
    assert list(table_lines(COLUMNS, ROWS, 23)) == list(table_lines(COLUMNS, ROWS, None))


def test_what_matters_least_goes_first_where_it_does_not_fit() -> None:
    assert list(table_lines(COLUMNS, ROWS, 22)) == ["name       count", "a              1", "long name  1,000"]
    assert list(table_lines(COLUMNS, ROWS, 15)) == ["name", "a", "long name"]


def test_what_stays_always_is_shortened_but_to_eight_columns_at_least() -> None:
    columns = (Column("name"), Column("kind"))
    rows = [("left_shoulder_link", "fixed"), ("arm", "revolute")]
    assert list(table_lines(columns, rows, 20)) == ["name        kind", "left…_link  fixed", "arm         revolute"]
    assert list(table_lines(columns, rows, 3))[1] == "lef…link  fixed"


def test_a_table_may_have_no_titles() -> None:
    assert list(table_lines(COLUMNS[:1], [("a",)], None, titles=False)) == ["a"]
    assert list(table_lines(COLUMNS, [], None, titles=False)) == []


def test_wide_letters_take_two_columns() -> None:
    assert list(table_lines(COLUMNS[::2], [("雷达", "1"), ("abcd", "2")], None, titles=False)) == ["雷达  1", "abcd  2"]


def test_empty_columns_are_left_out() -> None:
    assert list(table_lines(COLUMNS, [("a", "", "1")], None)) == ["name  count", "a         1"]


PLACES = {
    "frames": info._FRAMES,
    "times": info._TIMES,
    "senders": info._SENDERS,
    "topics": info._TOPICS,
    "senders with times": (*info._SENDERS, *info._TIMES),
    "monitor": monitor._COLUMNS,
    "compare": compare._COLUMNS,
    "robot": robot._COLUMNS,
}


@pytest.mark.parametrize(
    ("table", "leave", "left_aligned"),
    [
        ("frames", "span, longest gap, samples, authority, kind, rate", "frame, parent, kind, authority"),
        ("times", "period mean, period p99, delay mean, period max, delay p99, delay max", ""),
        ("senders", "frames, samples", "sender"),
        ("topics", "type, messages", "topic, type, read"),
        (
            "senders with times",
            "period mean, period p99, delay mean, period max, delay p99, delay max, frames, samples",
            "sender",
        ),
        ("monitor", "sender, jitter, late, lost, longest gap, p99, max, delay mean", "frame, sender"),
        ("compare", "std, median, min, mean, max, rmse", "error, unit"),
        ("robot", "type, joint", "frame, joint, type, position"),
    ],
)
def test_the_columns_of_each_command_leave_in_one_order_and_numbers_stand_at_the_right(
    table: str, leave: str, left_aligned: str
) -> None:
    columns: Sequence[Column] = PLACES[table]
    optional = [column for column in columns if column.importance is not None]
    assert ", ".join(column.title for column in sorted(optional, key=lambda column: column.importance or 0)) == leave
    assert len({column.importance for column in optional}) == len(optional)
    assert ", ".join(column.title for column in columns if not column.right) == left_aligned

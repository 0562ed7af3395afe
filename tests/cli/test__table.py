from tfbus.cli._table import Column, table_lines

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
    assert list(table_lines(COLUMNS, ROWS, 3)) == ["name", "a", "long name"]


def test_empty_columns_are_left_out() -> None:
    assert list(table_lines(COLUMNS, [("a", "", "1")], None)) == ["name  count", "a         1"]

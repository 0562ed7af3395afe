"""Tables of text, which leave out the least important columns where they would not fit."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

_GAP = "  "


class Column(NamedTuple):
    """A column of a table.

    Parameters
    ----------
    title : str
    right : bool
        Whether its cells stand at the right.
    importance : int or None
        Where the table is too wide, the column with the lowest number goes first; None stays always.
    """

    title: str
    right: bool = False
    importance: int | None = None


def table_lines(columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int | None) -> Iterator[str]:
    """The lines of a table, its titles first; empty columns are left out.

    Parameters
    ----------
    columns : sequence of Column
    rows : sequence of sequence of str
        The cells of each row; printable.
    width : int, optional
        The greatest length of a line, as far as leaving out columns can keep it.
    """
    shown = [at for at in range(len(columns)) if any(row[at] for row in rows)]
    widths = (
        [max(len(column.title), *(len(row[at]) for row in rows)) for at, column in enumerate(columns)] if rows else []
    )

    def too_wide() -> bool:
        return width is not None and sum(widths[at] for at in shown) + len(_GAP) * (len(shown) - 1) > width

    while too_wide():
        optional = [at for at in shown if columns[at].importance is not None]
        if not optional:
            break
        shown.remove(min(optional, key=lambda at: columns[at].importance or 0))
    for row in [[column.title for column in columns], *rows]:
        cells = (row[at].rjust(widths[at]) if columns[at].right else row[at].ljust(widths[at]) for at in shown)
        yield _GAP.join(cells).rstrip()

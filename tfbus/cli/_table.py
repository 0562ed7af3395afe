"""Tables of text, which leave out the least important columns where they would not fit, and shorten the others."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from tfbus.cli._width import align, cells, shorten, shorten_widest
from tfbus.plain import printable

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


def table_lines(
    columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int | None, titles: bool = True
) -> Iterator[str]:
    """The lines of a table, its titles first; empty columns are left out.

    Parameters
    ----------
    columns : sequence of Column
    rows : sequence of sequence of str
        The cells of each row; names need not be printable.
    width : int, optional
        The greatest length of a line; where columns that stay always do not fit, their longest cells are shortened.
    titles : bool
        Whether the first line has the titles.
    """
    rows = [list(map(printable, row)) for row in rows]
    shown = [at for at in range(len(columns)) if any(row[at] for row in rows)]
    lines = [[column.title for column in columns], *rows] if titles else list(rows)
    widths = [max(cells(line[at]) for line in lines) for at in range(len(columns))] if rows else []

    def room() -> int:
        return sum(widths) if width is None else width - len(_GAP) * (len(shown) - 1)

    while sum(widths[at] for at in shown) > room():
        optional = [at for at in shown if columns[at].importance is not None]
        if not optional:
            break
        shown.remove(min(optional, key=lambda at: columns[at].importance or 0))
    fitted = dict(zip(shown, shorten_widest([widths[at] for at in shown], room()), strict=True))
    for line in lines:
        yield _GAP.join(align(shorten(line[at], fitted[at]), fitted[at], columns[at].right) for at in shown).rstrip()

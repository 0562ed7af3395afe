"""The tree of frames on standard output: in colour on a terminal, as wide as it is, and redrawn in place if live."""

import sys
from collections.abc import Mapping, Sequence
from types import TracebackType

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from tfbus.cli.output import cells, narrow_guides, shorten, terminal_width
from tfbus.plain import printable
from tfbus.stamps import SECOND
from tfbus.tree.history import Edge
from tfbus.tree.rendering import Branch, branches, facts

_ASCII = str.maketrans("├└─│", "|`-|")
_LEAST_NAME = 12
"""The least width to which a name, or a sender, is shortened while something else can be left out."""
_LAYOUTS = (
    (4, ("rate", "age", "span", "authority")),
    (4, ("rate", "age", "span")),
    (2, ("rate", "age", "span")),
    (2, ("rate", "age")),
    (1, ("rate", "age")),
)
"""The width of a level and the facts that are shown, from the widest drawing to the narrowest."""
_STYLES = {"rate": "cyan", "age": "green", "span": "dim", "authority": "magenta"}


class TreeDisplay:
    """Shows lines once, or again and again: in place on a terminal, otherwise one below the other.

    Parameters
    ----------
    live : bool
        Whether they are shown more than once.
    """

    def __init__(self, live: bool) -> None:
        self._end = "\n" if live else ""
        self._console = Console()
        self._live: Live | None = None
        if live and self._console.is_interactive:
            self._live = Live(console=self._console, auto_refresh=False, redirect_stderr=sys.stderr.isatty())

    def show(self, edges: Sequence[Edge], now: int) -> None:
        """Draw the tree of the edges; ages are counted from `now`, in ns."""
        self.show_lines(tree_lines(edges, now, self._console.options.ascii_only, terminal_width()))

    def show_lines(self, lines: Sequence[Text]) -> None:
        """Show lines that fit the width of the terminal."""
        if self._live is not None:
            # The last line of the terminal is the cursor's.
            self._live.update(Group(*_fitting(lines, self._console.height - 1)), refresh=True)
            return
        with self._console.capture() as drawn:
            self._console.print(*lines, sep="\n", soft_wrap=True)
        # Rich would end the program by itself if the reader has closed the pipe.
        print(drawn.get(), end=self._end, flush=True)

    def __enter__(self) -> "TreeDisplay":
        if self._live is not None:
            self._live.start()
            # Rich hides the cursor, and a killed program could not show it again.
            self._console.show_cursor()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()


def tree_lines(edges: Sequence[Edge], now: int, ascii_only: bool = False, width: int | None = None) -> list[Text]:
    """The styled lines of the tree, one a frame, with rate, age, span and authority.

    Parameters
    ----------
    edges : sequence of Edge
    now : int
        The stamp from which ages are counted, in ns.
    ascii_only : bool
        Whether to draw the branches with ASCII characters.
    width : int, optional
        The greatest width of a line. Where they do not fit, senders are shortened or left out, then levels are drawn
        narrower, then spans are left out, and at last the names of frames are shortened.
    """
    # A `rich.tree.Tree` would leave out the frames that are nested deeper than the terminal is wide.
    rows = []
    for branch in branches(edges):
        known = {} if branch.edge is None else {fact: printable(text) for fact, text in facts(branch.edge, now).items()}
        guides = branch.guides.translate(_ASCII) if ascii_only else branch.guides
        rows.append((branch._replace(guides=guides, frame=printable(branch.frame)), known))
    if not rows:
        return [Text("(no frames)")]
    step, shown, room = _layout(rows, width)
    return [_line(branch, known, step, shown, room, width, now) for branch, known in rows]


_Row = tuple[Branch, Mapping[str, str]]


def _layout(rows: Sequence[_Row], width: int | None) -> tuple[int, Sequence[str], int]:
    """The width of a level, the facts to show, and the width of the column of frames."""
    for step, shown in _LAYOUTS:
        names = max(cells(narrow_guides(branch.guides, step)) + cells(branch.frame) for branch, _ in rows)
        room = names if width is None else width - max(_length(known, shown) for _, known in rows)
        if names <= room:
            break
    return step, shown, min(names, max(room, _LEAST_NAME))


def _length(known: Mapping[str, str], shown: Sequence[str]) -> int:
    """The least length of some facts; the sender may be shortened."""
    return sum(
        2 + (min(cells(text), _LEAST_NAME) if fact == "authority" else cells(text))
        for fact, text in known.items()
        if fact in shown
    )


def _line(
    branch: Branch, known: Mapping[str, str], step: int, shown: Sequence[str], room: int, width: int | None, now: int
) -> Text:
    guides = narrow_guides(branch.guides, step)
    # The nearest levels of a deep tree are the last of its guides.
    most = max(0, room - min(cells(branch.frame), _LEAST_NAME))
    if len(guides) > most:
        guides = f"…{guides[len(guides) - most + 1 :]}" if most else ""
    name = shorten(branch.frame, room - cells(guides))
    line = Text.assemble((guides, "dim"), (name, "bold"), no_wrap=True, overflow="ellipsis")
    if branch.edge is None:
        return line
    line.append(" " * (room - cells(guides) - cells(name)))
    for fact, text in known.items():
        if fact in shown:
            left = len(text) * 2 if width is None else width - cells(line.plain) - 2
            line.append("  ").append(shorten(text, left), _style(fact, branch.edge, now))
    return line


def _fitting(lines: Sequence[Text], height: int) -> Sequence[Text]:
    """The lines that fit a terminal; if some do not, the last line says how many."""
    if len(lines) <= height:
        return lines
    kept = max(0, height - 1)
    return [*lines[:kept], Text(f"… and {len(lines) - kept:,} lines more than fit", "yellow", no_wrap=True)]


def _style(fact: str, edge: Edge, now: int) -> str:
    stale = fact == "age" and edge.newest is not None and now - edge.newest > SECOND
    return "red" if stale else _STYLES[fact]

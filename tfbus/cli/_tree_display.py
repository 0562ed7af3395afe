"""The tree of frames on standard output: in colour on a terminal, and redrawn in place there if it is live."""

import sys
from collections.abc import Sequence
from types import TracebackType

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from tfbus.cli.output import printable
from tfbus.stamps import SECOND
from tfbus.tree.history import Edge
from tfbus.tree.rendering import branches, facts

_ASCII = str.maketrans("├└─│", "|`-|")
_STYLES = {"rate": "cyan", "age": "green", "span": "dim", "authority": "magenta"}


class TreeDisplay:
    """Shows a tree once, or again and again: in place on a terminal, otherwise one below the other.

    Parameters
    ----------
    live : bool
        Whether the tree is shown more than once.
    """

    def __init__(self, live: bool) -> None:
        self._end = "\n" if live else ""
        self._console = Console()
        self._live: Live | None = None
        if live and self._console.is_interactive:
            self._live = Live(console=self._console, auto_refresh=False, redirect_stderr=sys.stderr.isatty())

    def show(self, edges: Sequence[Edge], now: int) -> None:
        """Draw the edges; ages are counted from `now`, in ns."""
        lines = tree_lines(edges, now, ascii_only=self._console.options.ascii_only)
        if self._live is not None:
            self._live.update(Group(*lines), refresh=True)
            return
        with self._console.capture() as drawn:
            self._console.print(*lines, sep="\n", soft_wrap=True)
        # Rich would end the program by itself if the reader has closed the pipe.
        print(drawn.get(), end=self._end, flush=True)

    def __enter__(self) -> "TreeDisplay":
        if self._live is not None:
            self._live.start()
            # A killed program could not show it again.
            self._console.show_cursor()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()


def tree_lines(edges: Sequence[Edge], now: int, ascii_only: bool = False) -> list[Text]:
    """The styled lines of the tree, one a frame, with rate, age, span and authority.

    Parameters
    ----------
    edges : sequence of Edge
    now : int
        The stamp from which ages are counted, in ns.
    ascii_only : bool
        Whether to draw the branches with ASCII characters.
    """
    # A `rich.tree.Tree` would leave out the frames that are nested deeper than the terminal is wide.
    rows = []
    for branch in branches(edges):
        guides = branch.guides.translate(_ASCII) if ascii_only else branch.guides
        name = Text.assemble((guides, "dim"), (printable(branch.frame), "bold"), no_wrap=True, overflow="ellipsis")
        rows.append((name, branch.edge))
    width = max((name.cell_len for name, _ in rows), default=0)
    for name, edge in rows:
        if edge is not None:
            name.pad_right(width - name.cell_len)
            for fact, text in facts(edge, now).items():
                name.append("  ").append(text, _style(fact, edge, now))
    return [name for name, _ in rows] or [Text("(no frames)")]


def _style(fact: str, edge: Edge, now: int) -> str:
    stale = fact == "age" and edge.newest is not None and now - edge.newest > SECOND
    return "red" if stale else _STYLES[fact]

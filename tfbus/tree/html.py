"""A tree as HTML: for notebooks, and for the side panel of the live page."""

from collections.abc import Collection, Sequence
from html import escape

from tfbus.plain import printable
from tfbus.tree.edge_state import STALE_AFTER, EdgeState, state_of
from tfbus.tree.history import Edge
from tfbus.tree.rendering import branches, facts

_PRE = "font-family: monospace; font-size: 12px; line-height: 1.35; margin: 0; white-space: pre; overflow-x: auto"
_MARK = "background: #f0e442; color: #000000"


def to_html(
    edges: Sequence[Edge],
    now: int,
    stale_after: float = STALE_AFTER,
    *,
    marked: Collection[str] = (),
    with_facts: bool = True,
) -> str:
    """The edges as an indented tree, one frame a line, each frame in the colour of its state.

    Parameters
    ----------
    edges : sequence of Edge
    now : int
        The stamp (ns) that ages are counted from.
    stale_after : float
        The age, in s, from which a moving frame is stale.
    marked : collection of str
        Frames to highlight.
    with_facts : bool
        Whether the rate, age, span and authority follow each frame.

    Returns
    -------
    str
        One ``<pre>`` element. All names are escaped, one that has control characters too.
    """
    drawn = [(guides, frame, printable(frame), edge) for guides, frame, edge in branches(edges)]
    if not drawn:
        return f'<pre style="{_PRE}">(no frames)</pre>'
    width = max(len(guides + name) for guides, _, name, _ in drawn) + 2
    lines = []
    for guides, frame, name, edge in drawn:
        style = "font-weight: bold"
        if edge is not None:
            style += f"; color: {state_of(edge, now, stale_after).value}"
        if frame in marked:
            style += f"; {_MARK}"
        line = f'{guides}<span style="{style}">{escape(name)}</span>'
        if edge is not None and with_facts:
            line += " " * (width - len(guides + name)) + escape("  ".join(facts(edge, now).values()))
        lines.append(line)
    return f'<pre style="{_PRE}">{chr(10).join(lines)}</pre>'


def legend() -> str:
    """The colours of the states, as one line of HTML."""
    names = (f'<span style="color: {state.value}">\u25cf {state.name.lower()}</span>' for state in EdgeState)
    return f'<div style="font-size: 12px">{" &nbsp; ".join(names)}</div>'

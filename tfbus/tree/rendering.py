"""Renderings of a tree: text for people, Graphviz, and tf2's YAML."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from tfbus.plain import printable
from tfbus.stamps import SECOND, format_age, format_duration, format_stamp
from tfbus.tree.history import STALE_AFTER, Edge, EdgeState, state_of

_LONGEST_KEY = 1_024
"""The greatest length of a key in YAML, as it is written, without a question mark before it."""

_LEVEL = 4
_LONGEST_INDENT = 64 * _LEVEL
"""The greatest length of the lines before a frame. Deeper trees would take a text of quadratic length."""
_OUTER = "…   "
"""In place of the lines that are left out."""


def describe(edges: Sequence[Edge], now: int | None = None) -> str:
    """The edges as an indented tree, one frame a line, with rate, age, span and authority.

    Parameters
    ----------
    edges : sequence of Edge
    now : int, optional
        The stamp that ages are counted from, in ns; by default the newest among the edges.
    """
    if not edges:
        return "(no frames)"
    if now is None:
        now = max((edge.newest for edge in edges if edge.newest is not None), default=0)
    lines = [(f"{branch.guides}{printable(branch.frame)}", branch.edge) for branch in branches(edges)]
    width = max(len(label) for label, _ in lines) + 2
    return "\n".join(
        label if edge is None else f"{label:<{width}}{'  '.join(facts(edge, now).values())}" for label, edge in lines
    )


def counted(count: int, noun: str) -> str:
    """A number of things in words: ``1 frame``, ``1,000 frames``."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def facts(edge: Edge, now: int) -> dict[str, str]:
    """The rate, age, span and authority of an edge as texts, as far as the edge has them."""
    known = {"rate": _rate(edge)}
    if edge.oldest is not None and edge.newest is not None:
        known["age"] = format_age(edge.newest, now)
        known["span"] = f"span {format_duration(edge.newest - edge.oldest)}"
    if edge.authority:
        known["authority"] = f"from {edge.authority!r}"
    return known


def _rate(edge: Edge) -> str:
    return format_rate(edge.static, edge.newest, edge.rate)


def format_rate(static: bool, newest: int | None, rate: float | None) -> str:
    """The rate of an edge as text: ``static``, ``10.0 Hz``, ``one sample``."""
    if static:
        return "static"
    if newest is None:
        return "no samples"
    if rate is None:
        return "one sample"
    return f"{rate:.1f} Hz" if rate >= 1.0 else f"{rate:.2g} Hz"


class Branch(NamedTuple):
    """One line of a drawn tree: the lines before the frame, the frame, and its edge (None for a root)."""

    guides: str
    frame: str
    edge: Edge | None


def branches(edges: Sequence[Edge]) -> Iterator[Branch]:
    """The lines of a drawn tree, roots first. A loop of parents is opened at one of its frames.

    Below 64 levels, the outer lines before a frame are left out.
    """
    below: dict[str, list[Edge]] = {}
    for edge in edges:
        below.setdefault(edge.parent, []).append(edge)
    above = {edge.child: edge.parent for edge in edges}
    drawn: set[str] = set()
    for frame in [*sorted(parent for parent in below if parent not in above), *sorted(above)]:
        if frame in drawn:
            continue
        # A frame that no root leads to is in a loop, or below one: climb to the first frame that comes again.
        root = frame
        climbed: set[str] = set()
        while root in above and root not in climbed:
            climbed.add(root)
            root = above[root]
        drawn.add(root)
        yield Branch("", f"{root} (in a loop)" if root in above else root, None)
        stack = _stacked(below.get(root, []), "")
        while stack:
            edge, guides, indent = stack.pop()
            if edge.child in drawn:
                continue
            drawn.add(edge.child)
            yield Branch(guides, edge.child, edge)
            stack.extend(_stacked(below.get(edge.child, []), indent))


def _stacked(edges: list[Edge], indent: str) -> list[tuple[Edge, str, str]]:
    if len(indent) >= _LONGEST_INDENT:
        indent = _OUTER + indent[len(_OUTER) + _LEVEL :]
    rows = [(edge, f"{indent}├── ", f"{indent}│   ") for edge in edges[:-1]]
    rows += [(edge, f"{indent}└── ", f"{indent}    ") for edge in edges[-1:]]
    return rows[::-1]


_WIDEST_TREE = 15
"""The most edges of a tree that is drawn downwards."""


def to_dot(edges: Sequence[Edge], now: int | None = None, delays: Mapping[str, float] | None = None) -> str:
    """The edges in Graphviz's language; static ones are dashed.

    Parameters
    ----------
    edges : sequence of Edge
    now : int, optional
        With it, each edge has the colour of its state at this stamp (ns), and its age and span in the label. A tree of
        many frames grows to the right, so that it is not many times as wide as high.
    delays : mapping of str to float, optional
        By child, the mean time in s from the stamp of a sample to its arrival; shown in the label.
    """
    lines = ["digraph tf {"]
    if now is not None:
        lines += [
            '    node [shape=box, style=rounded, fontname="Helvetica", fontsize=11, height=0.3];',
            '    edge [fontname="Helvetica", fontsize=9];',
        ]
        if len(edges) > _WIDEST_TREE:
            lines.append("    rankdir=LR; nodesep=0.3; ranksep=0.2;")
    for edge in edges:
        known = {"rate": _rate(edge)} if now is None else facts(edge, now)
        known["authority"] = edge.authority
        if now is not None and delays is not None and edge.child in delays:
            known["delay"] = f"delay {format_duration(round(delays[edge.child] * SECOND))}"
        label = r"\n".join(_label(text)[1:-1] for text in known.values() if text)
        style = ", style=dashed" if edge.static else ""
        if now is not None:
            colour = state_of(edge, now).value
            style += f', color="{colour}", fontcolor="{colour}"'
        lines.append(f'    {quoted(edge.parent)} -> {quoted(edge.child)} [label="{label}"{style}];')
    for frame in dict.fromkeys(name for edge in edges for name in (edge.parent, edge.child)):
        # Graphviz would break lines at such escapes, and decode HTML entities.
        if not frame.isprintable() or "&" in frame:
            lines.append(f"    {quoted(frame)} [label={_label(frame)}];")
    return "\n".join([*lines, "}", ""])


def to_yaml(edges: Sequence[Edge]) -> str:
    """The edges as YAML with the keys of tf2's ``all_frames_as_yaml``; stamps and lengths in s, null where static."""
    if not edges:
        return "{}\n"
    lines = []
    for edge in edges:
        length = None if edge.oldest is None or edge.newest is None else edge.newest - edge.oldest
        facts = {
            "parent": quoted(edge.parent),
            "broadcaster": quoted(edge.authority),
            "static": json.dumps(edge.static),
            "rate": json.dumps(edge.rate),
            "most_recent_transform": _seconds(edge.newest),
            "oldest_transform": _seconds(edge.oldest),
            "buffer_length": _seconds(length),
        }
        key = quoted(edge.child)
        lines.append(f"{key}:" if len(key) <= _LONGEST_KEY else f"? {key}\n:")
        lines += [f"  {key}: {value}" for key, value in facts.items()]
    return "\n".join([*lines, ""])


def _seconds(stamp: int | None) -> str:
    """Exact, and never with an exponent, which YAML 1.1 takes for a string."""
    return "null" if stamp is None else format_stamp(stamp).removesuffix(" s")


def quoted(text: str) -> str:
    """In double quotes, as YAML reads it back. Graphviz knows no ``\\u``, but still tells the names apart."""
    result = json.dumps(text, ensure_ascii=False)
    if result.isprintable():
        return result
    return "".join(letter if letter.isprintable() else _escaped(ord(letter)) for letter in result)


def _escaped(code: int) -> str:
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def _label(text: str) -> str:
    """In double quotes, so that Graphviz shows the text to people as it is."""
    return quoted(printable(text).replace("&", "&amp;"))


_PRE = "font-family: monospace; font-size: 12px; line-height: 1.35; margin: 0; white-space: pre; overflow-x: auto"


def to_html(
    edges: Sequence[Edge],
    now: int,
    stale_after: float = STALE_AFTER,
) -> str:
    """The edges as an indented tree, one frame a line, each frame in the colour of its state.

    Parameters
    ----------
    edges : sequence of Edge
    now : int
        The stamp (ns) that ages are counted from.
    stale_after : float
        The age, in s, from which a moving frame is stale.

    Returns
    -------
    str
        One ``<pre>`` element. All names are escaped, control characters too.
    """
    # Few processes show a page, and the names of all entities take memory.
    from html import escape

    drawn = [(guides, printable(frame), edge) for guides, frame, edge in branches(edges)]
    if not drawn:
        return f'<pre style="{_PRE}">(no frames)</pre>'
    width = max(len(guides + name) for guides, name, _ in drawn) + 2
    lines = []
    for guides, name, edge in drawn:
        style = "font-weight: bold"
        if edge is not None:
            style += f"; color: {state_of(edge, now, stale_after).value}"
        line = f'{guides}<span style="{style}">{escape(name)}</span>'
        if edge is not None:
            line += " " * (width - len(guides + name)) + escape("  ".join(facts(edge, now).values()))
        lines.append(line)
    return f'<pre style="{_PRE}">{chr(10).join(lines)}</pre>'


def cell(tree: str) -> str:
    """The HTML of a tree as a notebook shows it: a large tree scrolls inside its cell, above the legend."""
    return f'<div style="max-height: 36em; overflow-y: auto">{tree}</div>{legend()}'


def legend() -> str:
    """The colours of the states, as one line of HTML."""
    names = (f'<span style="color: {state.value}">\u25cf {state.name.lower()}</span>' for state in EdgeState)
    return f'<div style="font-size: 12px">{" &nbsp; ".join(names)}</div>'

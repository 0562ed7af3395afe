"""Pictures of a tree: text for people, Graphviz, and tf2's YAML."""

import json
from collections.abc import Iterator, Sequence

from tfbus.history import Edge
from tfbus.stamps import format_duration, to_seconds


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
    lines = list(_branches(edges))
    width = max(len(label) for label, _ in lines) + 2
    return "\n".join(
        label if edge is None else f"{label:<{width}}{_facts(edge, now)}".rstrip() for label, edge in lines
    )


def _facts(edge: Edge, now: int) -> str:
    sender = f"  from {edge.authority!r}" if edge.authority else ""
    if edge.static:
        return f"static{sender}"
    if edge.oldest is None or edge.newest is None:
        return f"no samples{sender}"
    rate = "one sample" if edge.rate is None else f"{edge.rate:.1f} Hz"
    span = format_duration(edge.newest - edge.oldest)
    return f"{rate}  age {format_duration(now - edge.newest)}  span {span}{sender}"


def _branches(edges: Sequence[Edge]) -> Iterator[tuple[str, Edge | None]]:
    """Each frame's label and its edge, roots first; a loop is opened at its first frame."""
    below: dict[str, list[Edge]] = {}
    for edge in edges:
        below.setdefault(edge.parent, []).append(edge)
    children = {edge.child for edge in edges}
    drawn: set[str] = set()
    for root in [*sorted(parent for parent in below if parent not in children), *sorted(children)]:
        if root in drawn:
            continue
        drawn.add(root)
        yield (f"{root} (in a loop)" if root in children else root), None
        stack = _stacked(below.get(root, []), "")
        while stack:
            edge, branch, indent = stack.pop()
            if edge.child in drawn:
                continue
            drawn.add(edge.child)
            yield branch + edge.child, edge
            stack.extend(_stacked(below.get(edge.child, []), indent))


def _stacked(edges: list[Edge], indent: str) -> list[tuple[Edge, str, str]]:
    rows = [(edge, f"{indent}├── ", f"{indent}│   ") for edge in edges[:-1]]
    rows += [(edge, f"{indent}└── ", f"{indent}    ") for edge in edges[-1:]]
    return rows[::-1]


def to_dot(edges: Sequence[Edge]) -> str:
    """The edges in Graphviz's language; static ones are dashed."""
    lines = ["digraph tf {"]
    for edge in edges:
        label = "static" if edge.static else "no samples" if edge.rate is None else f"{edge.rate:.1f} Hz"
        if edge.authority:
            label += f"\n{edge.authority}"
        style = ", style=dashed" if edge.static else ""
        lines.append(f"    {json.dumps(edge.parent)} -> {json.dumps(edge.child)} [label={json.dumps(label)}{style}];")
    return "\n".join([*lines, "}", ""])


def to_yaml(edges: Sequence[Edge]) -> str:
    """The edges as YAML with the keys of tf2's ``all_frames_as_yaml``; stamps and lengths in s, null where static."""
    if not edges:
        return "{}\n"
    lines = []
    for edge in edges:
        oldest = None if edge.oldest is None else to_seconds(edge.oldest)
        newest = None if edge.newest is None else to_seconds(edge.newest)
        facts = {
            "parent": edge.parent,
            "broadcaster": edge.authority,
            "static": edge.static,
            "rate": edge.rate,
            "most_recent_transform": newest,
            "oldest_transform": oldest,
            "buffer_length": None if oldest is None or newest is None else newest - oldest,
        }
        lines.append(f"{json.dumps(edge.child)}:")
        lines += [f"  {key}: {json.dumps(value)}" for key, value in facts.items()]
    return "\n".join([*lines, ""])

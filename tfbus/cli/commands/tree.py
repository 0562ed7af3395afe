"""``tfbus tree``."""

import json
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tfbus.cli.arguments import Duration, Flag, JsonFlag, Rate, UsageError
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import print_now, say, write_file
from tfbus.cli.recordings import DEFAULT_TOPICS, TopicOptions, load_tree

with lazy_imports():
    import anyio.to_thread

    from tfbus.analysis.arrivals import Delays
    from tfbus.buffer.buffer import Buffer
    from tfbus.bus.bus import Bus
    from tfbus.cli.replay_clock import ReplayClock
    from tfbus.cli.tree_display import TreeDisplay
    from tfbus.links.link import Link
    from tfbus.stamps import to_seconds
    from tfbus.tree.history import Edge
    from tfbus.tree.rendering import to_dot
    from tfbus.tree.tree import TransformTree

_LEAST_DURATION, _LONGEST_DURATION = 1.0, 5.0
_LOOK_AGAIN = 0.1
"""s."""
_NAMED = 5
"""The number of frames that a remark names."""


def tree(
    file: Path | None = None,
    /,
    *,
    duration: Duration | None = None,
    watch: Flag = False,
    rate: Rate = 1.0,
    dot: Path | None = None,
    svg: Path | None = None,
    pdf: Path | None = None,
    png: Path | None = None,
    as_json: JsonFlag = False,
    topics: TopicOptions = DEFAULT_TOPICS,
    link: LinkOptions = DEFAULT_LINK,
) -> None:
    """Show all frames as a tree, each with its rate, the age and span of its samples, and its authority.

    Standard error says how many programs it hears, and how they are reached.

    Example: tfbus tree --svg frames.svg

    Example: tfbus tree run.mcap --svg frames.svg

    Parameters
    ----------
    file
        A recording to show in place of a domain; ages are counted from its newest stamp.
    duration
        How many seconds to listen, from the first transform on; by default until every frame has been heard twice and
        all are connected, at least 1 and at most 5.
    watch
        Show it live until Ctrl-C; if the output is not a terminal, print it again and again.
    rate
        Updates per second, with --watch.
    dot
        Also write the tree to this file, for Graphviz.
    svg
        Also draw the tree into this file: each edge with its rate, age, span, authority and delay, the time from the
        stamp of its samples to their arrival, in the colour of its state. Needs Graphviz.
    pdf
        The same as a PDF.
    png
        The same as a PNG.
    as_json
        Print a JSON document instead, with --watch one a line: for each frame its parent, kind, rate (Hz), age (s),
        span (s) and authority; null for a value that the frame does not have.
    """
    links: list[Link] = []
    pictures = {kind: path for kind, path in (("svg", svg), ("pdf", pdf), ("png", png)) if path is not None}

    def write_pictures(edges: Sequence[Edge], now: int, delays: Mapping[str, float] | None = None) -> None:
        if dot is not None:
            write_file(dot, to_dot(edges).encode())
        for kind, path in pictures.items():
            draw(to_dot(edges, now, delays), kind, path)

    if file is not None:
        if watch or duration is not None:
            raise UsageError("--watch and --duration are for a domain, not for a recording")
        recorded, _ = load_tree(file, topics)
        edges = recorded.edges()
        now = max((edge.newest for edge in edges if edge.newest is not None), default=0)
        write_pictures(edges, now)
        if as_json:
            print(json.dumps({"file": str(file), **to_document(recorded.frames(), edges, now)}, indent=2))
        else:
            with TreeDisplay(live=False) as display:
                display.show(edges, now)
        return

    async def show_tree(bus: Bus) -> None:
        delays = Delays()
        with (
            Buffer(bus) as buffer,
            bus.subscribe(lambda batch: delays.note(batch, bus.clock.now()), delays.forget),
            TreeDisplay(live=watch and not as_json) as display,
        ):

            async def show_once() -> None:
                edges, now = buffer.tree.edges(), bus.clock.now()
                if dot is not None or pictures:
                    await anyio.to_thread.run_sync(write_pictures, edges, now, delays.by_frame)
                if as_json:
                    document = {"domain": link.domain, **to_document(buffer.tree.frames(), edges, now)}
                    print_now(json.dumps(document, indent=None if watch else 2))
                else:
                    display.show(edges, now)

            await link.first_transform(bus, links)
            if watch:
                async for _ in bus.clock.ticks(rate):
                    await show_once()
            else:
                if duration is None:
                    await _listen_for_a_period(bus, buffer.tree)
                else:
                    await bus.clock.sleep(duration)
                await show_once()
                for remark in remarks(buffer.tree.edges()):
                    say(remark)
                link.print_peers(links)

    link = replace(link, odometry=topics.odometry, invert=topics.invert)
    link.run(show_tree, clock=ReplayClock(), links=links)


async def _listen_for_a_period(bus: Bus, tree: TransformTree) -> None:
    """Wait until each moving frame has been heard twice and all frames are connected, or until the time is up."""
    await bus.clock.sleep(_LEAST_DURATION)
    with bus.clock.move_on_after(_LONGEST_DURATION - _LEAST_DURATION):
        while remarks(tree.edges()):
            await bus.clock.sleep(_LOOK_AGAIN)


def remarks(edges: Sequence[Edge]) -> list[str]:
    """Facts that a drawing of the edges does not show: rates of frames that were heard once, missing connections."""
    lines = []
    once = [edge.child for edge in edges if not edge.static and edge.samples == 1]
    if once:
        lines.append(f"one sample only, so the rate is not known: {_names(once)}")
    children = {edge.child for edge in edges}
    roots = sorted({edge.parent for edge in edges} - children)
    if len(roots) > 1:
        lines.append(f"{len(roots):,} trees, below {_names(roots)}: no edge between them was sent meanwhile")
    return lines


def _names(frames: Sequence[str]) -> str:
    named = ", ".join(frames[:_NAMED])
    return named + (f" and {len(frames) - _NAMED:,} more" if len(frames) > _NAMED else "")


def to_document(frames: Iterable[str], edges: Iterable[Edge], now: int) -> dict[str, Any]:
    """The JSON document of the tree, without its place; ages are counted from `now`, in ns."""
    edge_above = {edge.child: edge for edge in edges}
    return {
        "stamp": now,
        "frames": {frame: _describe(edge_above.get(frame), now) for frame in frames},
    }


def _describe(edge: Edge | None, now: int) -> dict[str, Any]:
    if edge is None:
        return {"parent": None, "kind": "root", "rate": None, "age": None, "span": None, "authority": None}
    age = span = None
    if edge.oldest is not None and edge.newest is not None:
        age, span = to_seconds(now - edge.newest), to_seconds(edge.newest - edge.oldest)
    return {
        "parent": edge.parent,
        "kind": "static" if edge.static else "moving",
        "rate": edge.rate,
        "age": age,
        "span": span,
        "authority": edge.authority,
    }


def draw(dot: str, kind: str, path: Path) -> None:
    """Draw a graph into a file, all of it or nothing; a pipe or a device is written to directly.

    Parameters
    ----------
    dot : str
        The graph in Graphviz's language.
    kind : {"svg", "pdf", "png"}
    path : Path

    Raises
    ------
    UsageError
        If Graphviz is not installed or fails, or the file cannot be written.
    """
    try:
        drawn = subprocess.run(["dot", f"-T{kind}"], input=dot.encode(), capture_output=True, check=False)
    except FileNotFoundError:
        raise UsageError(
            f"--{kind} needs Graphviz: install it (apt install graphviz, brew install graphviz), or write --dot"
        ) from None
    if drawn.returncode != 0:
        raise UsageError(f"Graphviz could not draw the tree: {' '.join(drawn.stderr.decode(errors='replace').split())}")
    write_file(path, drawn.stdout)

"""``tfbus tree``."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from tfbus.buffer.buffer import Buffer
from tfbus.bus.bus import Bus
from tfbus.cli.domain import LOCAL, LinkOptions, UnusableError
from tfbus.cli.options import Duration, Rate
from tfbus.stamps import to_seconds
from tfbus.tree.history import Edge


def tree(
    *,
    duration: Duration = 1.0,
    watch: Annotated[bool, Parameter(negative="")] = False,
    rate: Rate = 1.0,
    dot: Path | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
    link: LinkOptions = LOCAL,
) -> None:
    """Show all frames as a tree, with how often each comes, how old its newest sample is, and who sends it.

    Example: tfbus tree --dot frames.dot && dot -Tsvg frames.dot -o frames.svg

    Parameters
    ----------
    duration
        For how many seconds to listen, from the first transform on.
    watch
        Show it live until Ctrl-C; where the output is no terminal, print it again and again.
    rate
        How often, in Hz, with --watch.
    dot
        Write the tree to this file as well, for Graphviz.
    as_json
        Print a JSON document instead, with --watch one a line: for each frame its parent, kind, rate (Hz), age (s),
        span (s) and authority; null for what it does not have.
    """
    from tfbus.cli.tree_display import TreeDisplay

    async def show(bus: Bus) -> None:
        with Buffer(bus) as buffer, TreeDisplay(live=watch and not as_json) as display:

            def present() -> None:
                edges, now = buffer.tree.edges(), bus.clock.now()
                if dot is not None:
                    write(dot, buffer.tree.to_dot())
                if as_json:
                    facts = document(link.domain, buffer.tree.frames(), edges, now)
                    print(json.dumps(facts, indent=None if watch else 2), flush=True)
                else:
                    display.show(edges, now)

            await link.first_transform(bus)
            if not watch:
                await bus.clock.sleep(duration)
                present()
                return
            async for _ in bus.clock.ticks(rate):
                present()

    link.run(show)


def document(domain: str, frames: Iterable[str], edges: Iterable[Edge], now: int) -> dict[str, Any]:
    """The tree as JSON has it; ages are counted from `now`, in ns."""
    known = {edge.child: edge for edge in edges}
    return {
        "domain": domain,
        "stamp": now,
        "frames": {frame: _facts(known.get(frame), now) for frame in frames},
    }


def write(path: Path, text: str) -> None:
    """Put a text into a file, all of it or nothing; a pipe or a device just gets it."""
    replaceable = path.is_file() or not path.exists()
    unfinished = path.with_name(f".{path.name}.part") if replaceable else path
    try:
        unfinished.write_text(text, encoding="utf-8")
        if replaceable:
            unfinished.replace(path)
    except OSError as error:
        if replaceable:
            unfinished.unlink(missing_ok=True)
        raise UnusableError(f"cannot write {path}: {error.strerror}") from None


def _facts(edge: Edge | None, now: int) -> dict[str, Any]:
    if edge is None:
        return {"parent": None, "kind": "root", "rate": None, "age": None, "span": None, "authority": None}
    age = span = None
    if edge.oldest is not None and edge.newest is not None:
        age, span = to_seconds(now - edge.newest), to_seconds(edge.newest - edge.oldest)
    kind = "static" if edge.static else "moving"
    return {
        "parent": edge.parent,
        "kind": kind,
        "rate": edge.rate,
        "age": age,
        "span": span,
        "authority": edge.authority,
    }

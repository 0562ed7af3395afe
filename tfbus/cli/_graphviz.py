"""Pictures of trees by Graphviz's ``dot``."""

import subprocess
from pathlib import Path

from tfbus.cli.arguments import UsageError
from tfbus.cli.output import write_file


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

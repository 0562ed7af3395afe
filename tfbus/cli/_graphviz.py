"""Pictures of trees by Graphviz's ``dot``."""

import subprocess
from pathlib import Path

from tfbus.cli.arguments import UsageError


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
        raise UsageError(f"Graphviz could not draw the tree: {drawn.stderr.decode(errors='replace').strip()}")
    write_file(path, drawn.stdout)


def write_file(path: Path, content: bytes) -> None:
    """Write a file, all of it or nothing; a pipe or a device is written to directly.

    Raises
    ------
    UsageError
        If the file cannot be written.
    """
    replaceable = path.is_file() or not path.exists()
    written = path.with_name(f".{path.name}.part") if replaceable else path
    try:
        written.write_bytes(content)
        if replaceable:
            written.replace(path)
    except OSError as error:
        if replaceable:
            written.unlink(missing_ok=True)
        raise UsageError(f"cannot write {path}: {error.strerror}") from None

"""Tools that anyio lacks: for tasks, streams and threads."""

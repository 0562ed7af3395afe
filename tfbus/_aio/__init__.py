"""What anyio lacks: small tools for tasks, streams and threads."""

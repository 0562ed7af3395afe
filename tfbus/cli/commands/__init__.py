"""The subcommands of ``tfbus``, one module each."""

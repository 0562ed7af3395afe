"""The subcommands of ``tfbus``, one module each; the subcommands of the tutorial share a module."""

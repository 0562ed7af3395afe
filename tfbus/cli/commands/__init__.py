"""The subcommands of ``tfbus``, one module each; those of the tutorial share one."""

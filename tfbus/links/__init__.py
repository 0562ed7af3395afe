"""Links join a bus to those of other processes; each needs an extra of its own."""

"""``python -m tfbus``: the command."""

from tfbus.cli import main

if __name__ == "__main__":
    main()

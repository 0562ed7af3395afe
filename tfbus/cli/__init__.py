"""The command ``tfbus``. Of the subcommands in `tfbus.cli.commands`, it loads only the one that is called.

Standard output carries the result of a command; notices, warnings and errors go to standard error.
"""

# `signal` would load enum, and Ctrl-C would still show a traceback meanwhile.
import _signal as signal  # type: ignore[import-not-found]
import gc
import sys


def main() -> None:
    """Run the command and exit with the status that its help names; Ctrl-C never shows a traceback.

    While modules are loaded, and after the command has ended, Ctrl-C has its default action, which is silent: a
    `KeyboardInterrupt` would show a traceback there.
    """
    is_default = signal.getsignal(signal.SIGINT) is signal.default_int_handler

    def begin() -> None:
        gc.freeze()
        gc.enable()
        if is_default:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    if is_default:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Modules are never garbage: a collection while they are loaded takes a sixth of the time of the help.
    gc.disable()
    from tfbus.cli.application import run

    try:
        status = run(sys.argv[1:], begin)
    finally:
        gc.enable()
        if is_default:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(status)

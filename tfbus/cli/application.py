"""The command line in cyclopts: the subcommands, and the options of all of them."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

try:
    from cyclopts import App, Group, Parameter
except ImportError:
    from tfbus.errors import pip_install

    raise SystemExit(f"tfbus: the command needs some packages more: {pip_install('cli')}") from None

from tfbus.cli._overview import COMMANDS, EXIT_STATUSES, INSTALL_COMPLETION, SUMMARY

LogLevel = Literal["debug", "info", "warning", "error", "critical"]
"""A level of the module `logging`."""

Program = Callable[[], object]


def _version() -> str:
    # Loaded here, because most commands do without.
    from importlib.metadata import version

    from tfbus.which_kernel import kernel

    return f"{version('tfbus')} ({kernel} kernel)"


def _shown_default(default: object) -> str | None:
    """A default as the help shows it; None where the option changes nothing unless it is given."""
    return None if default is None or default is False or default in ("", ()) else str(default)


def application(command: str | None) -> App:
    """The command line with all its subcommands, none of which is loaded before it is parsed.

    Parameters
    ----------
    command : str or None
        The subcommand that is about to be parsed; it shows the whole help of its function.
    """
    app = App(
        name="tfbus",
        help=SUMMARY,
        version=_version,
        help_epilogue=EXIT_STATUSES,
        # To load a parser of Markdown takes as long as all the rest of the list of commands.
        help_format="plaintext" if command is None else "markdown",
        suppress_keyboard_interrupt=False,
        default_parameter=Parameter(negative_iterable="", show_default=_shown_default),
    )
    for name, summary in COMMANDS.items():
        app.command(f"tfbus.cli.commands.{name}:{name}", name=name, help=None if name == command else summary)
    app.register_install_completion_command(help=INSTALL_COMPLETION)

    @app.meta.default
    def prepare(
        *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        log_level: Annotated[LogLevel, Parameter(group=Group("Options of all commands", sort_key=9))] = "warning",
    ) -> Program:
        """Parse the command line.

        Parameters
        ----------
        log_level
            The least important log lines that are shown on standard error.
        """
        function, arguments, _ = app.parse_args(words, exit_on_error=False, print_error=False)
        return partial(_run_logging, log_level, partial(function, *arguments.args, **arguments.kwargs))

    return app


def _run_logging(level: LogLevel, program: Program) -> None:
    from tfbus.cli._log_lines import log_lines

    with log_lines(level.upper()):
        program()

"""The command line: the subcommands, and their common options.

`parser_of` parses the words with cyclopts. It loads the module of the one subcommand that they name, and the work of
that module only if they neither are wrong nor ask for help: see `tfbus.cli.lazy_imports`.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, Final, Literal, get_args

from tfbus.cli.lazy_imports import deferring
from tfbus.cli.statuses import USAGE_ERROR
from tfbus.cli.version import version
from tfbus.tf2_names import ours

COMMANDS = {
    "bridge": "Pass on all frames between FIRST and SECOND, both ways, until Ctrl-C.",
    "broadcast": "Broadcast the transform of the tutorial's laser, until Ctrl-C; tfbus listen in another terminal "
    "receives it.",
    "check": "Find faults in a recording, or in a domain for some time: which, when, how often, and what to do.",
    "compare": "Compare the trajectory of a frame in two recordings: absolute and relative pose error, aligned and "
    "not.",
    "convert": "Write recordings to a new one: in another format, a part of them, renamed, or several merged by their "
    "log times.",
    "demo": "Run the tutorial's robot: a 100 Hz broadcaster and a 1 Hz listener in one process, until Ctrl-C.",
    "echo": "Print the transform of SOURCE in TARGET again and again, until Ctrl-C.",
    "foxglove": "Show the frames of a domain to the Foxglove application, until Ctrl-C.",
    "info": "Print the contents of a recording: its topics, its frames with parents, rates, gaps and delays, and its "
    "senders.",
    "listen": "Print a point of the tutorial's laser in the frame of the base, again and again, until Ctrl-C.",
    "monitor": "Measure the rate, the delay, the jitter and the losses of each frame and sender of a domain, until "
    "Ctrl-C.",
    "play": "Publish a recording on a domain with its original stamps and timing, static transforms first.",
    "plot": "Plot the transforms of some frames from a recording over time: FILE TARGET SOURCE...",
    "query": "Print the transform of SOURCE in TARGET from a recording: the newest, at an instant, or at many.",
    "record": "Record all transforms of a domain to FILE, in MCAP as ROS 2 and Foxglove read it, until Ctrl-C.",
    "robot": "Publish the frames of a robot until Ctrl-C, or print them as a tree.",
    "rosbridge": "Serve the frames of a domain to web pages with roslib, as a rosbridge server of ROS does, until "
    "Ctrl-C.",
    "router": "Connect the programs of all domains with each other, until Ctrl-C.",
    "static": "Publish the static transform of CHILD in PARENT, or all transforms of a file, until Ctrl-C.",
    "tree": "Show all frames as a tree, each with its rate, the age and span of its samples, and its authority.",
    "view": "Show the frames of a domain, or of a recording, as a live 3D page in the browser, until Ctrl-C.",
}
"""The first line of the help of each subcommand, so that a list of them loads none."""

_OPTIONAL = {
    "check": "[WHAT]",
    "convert": "SOURCE [FURTHER...]",
    "monitor": "[TARGET SOURCE]",
    "plot": "FILE [FRAMES...]",
    "query": "FILE TARGET SOURCE [FURTHER...]",
    "robot": "[FILE] [POSITION...]",
    "static": "PARENT [CHILD]",
    "tree": "[FILE]",
    "view": "[FILE]",
}
"""The arguments of each subcommand that may be left out in part; cyclopts does not name them."""

_MODULES = dict.fromkeys(("broadcast", "demo", "listen"), "tutorial")
"""The module of a subcommand, where it is not the one of its name."""
_SUMMARY = "Stamped coordinate transforms for asyncio and trio."
_EXIT_STATUSES = (
    "Exit status: 0 success; 1 a lookup or a recording has failed, or a check has found something; 2 wrong usage, or a "
    "file that cannot be used; 130 ended by Ctrl-C; 143 ended by a termination. Environment variables: "
    "TFBUS_DOMAIN, TFBUS_CONNECT (addresses with blanks between them), TFBUS_RUNTIME_DIR (where programs of this "
    "machine meet), NO_COLOR."
)
_INSTALL_COMPLETION = "Install completion for the current shell, and exit."
_OPTIONS_OF_ALL = "Options of all commands"
_FOR_ALL_COMMANDS = ("-h", "--help", "--version", "--install-completion", "--log-level")
_LOG_LEVEL = "Show log lines of this level and above on standard error."

_LogLevel = Literal["debug", "info", "warning", "error", "critical"]
_DEFAULT_LEVEL: Final = "warning"
_Program = Callable[[], int | None]


def parser_of(words: Sequence[str]) -> Callable[[], _Program | None]:
    """A function that parses the words after ``tfbus`` and gives their program, or None if it has printed some help."""
    if list(words) in ([], ["-h"], ["--help"]):
        return _print_overview
    # `info` is a level of the log, too.
    named = (word for before, word in zip(("", *words), words, strict=False) if before != "--log-level")
    plain = [word for word in named if not word.startswith("-")]
    command = next((word for word in plain if word in COMMANDS), None)
    if command is None and plain and (hint := ours("command", plain[0])):
        return lambda: partial(_refuse, plain[0], hint)
    app = application(command)

    def parse() -> _Program | None:
        with deferring() as load:
            if any(word.startswith(_FOR_ALL_COMMANDS) for word in words):
                prepare, arguments, _ = app.meta.parse_args(words, exit_on_error=False, print_error=False)
                program: _Program | None = prepare(*arguments.args, **arguments.kwargs)
            else:
                # To look for these options takes as long as all else.
                program = app.meta.default_command(*words)
            if program is not None:
                load()
        return program

    return parse


def _refuse(command: str, hint: str) -> int:
    print(f"tfbus: there is no command {command!r}: {hint}", file=sys.stderr)
    return USAGE_ERROR


def _print_overview() -> None:
    print(_overview())


def _overview() -> str:
    """The help of all commands, laid out as cyclopts does it."""
    import shutil
    import textwrap

    width = shutil.get_terminal_size((80, 24)).columns
    commands = COMMANDS | {
        "--help (-h)": "Display this message and exit.",
        "--install-completion": _INSTALL_COMPLETION,
        "--version": "Display application version.",
    }
    levels = f"[choices: {', '.join(get_args(_LogLevel))}] [default: {_DEFAULT_LEVEL}]"
    parts = (
        "Usage: tfbus COMMAND [OPTIONS]\n",
        _SUMMARY + "\n",
        _panel("Commands", commands, width),
        _panel(_OPTIONS_OF_ALL, {"--log-level CHOICE": f"{_LOG_LEVEL} {levels}"}, width) + "\n",
        textwrap.fill(_EXIT_STATUSES, width, break_on_hyphens=False),
    )
    text = "\n".join(parts)
    try:
        text.encode(sys.stdout.encoding or "ascii")
    except UnicodeEncodeError:
        return text.translate(str.maketrans("╭╮╰╯─│", "++++-|"))
    return text


def _panel(title: str, rows: Mapping[str, str], width: int) -> str:
    """A box; each row has a name and its meaning."""
    import textwrap

    names = max(map(len, rows))
    room = max(width - names - 6, 8)
    lines = [
        f"│ {'' if number else name:{names}}  {line:{room}} │"
        for name, meaning in rows.items()
        for number, line in enumerate(textwrap.wrap(meaning, room, break_on_hyphens=False))
    ]
    rule = "─" * (names + room + 4)
    return "\n".join((f"╭─ {title} {rule[len(title) + 3 :]}╮", *lines, f"╰{rule}╯"))


def application(command: str | None) -> Any:
    """The command line with all its subcommands; a subcommand is loaded only when it is parsed.

    Parameters
    ----------
    command : str or None
        The subcommand that is about to be parsed; it shows the whole help of its function.

    Returns
    -------
    cyclopts.App
    """
    try:
        from cyclopts import App, Group, Parameter
    except ImportError:
        from tfbus.errors import pip_install

        raise SystemExit(f"tfbus: the command needs more packages: {pip_install('cli')}") from None
    app = App(
        name="tfbus",
        help=_SUMMARY,
        version=version,
        help_epilogue=_EXIT_STATUSES,
        # Loading a parser of Markdown takes as long as everything else for the list of commands.
        help_format="plaintext" if command is None else "markdown",
        suppress_keyboard_interrupt=False,
        default_parameter=Parameter(negative_iterable="", show_default=_shown_default),
    )
    for name, summary in COMMANDS.items():
        path = f"tfbus.cli.commands.{_MODULES.get(name, name)}:{name}"
        usage = f"Usage: tfbus {name} [OPTIONS] {_OPTIONAL[name]}" if name in _OPTIONAL else None
        app.command(path, name=name, help=None if name == command else summary, usage=usage)
    app.register_install_completion_command(help=_INSTALL_COMPLETION)

    @app.meta.default
    def prepare(
        *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        log_level: Annotated[
            _LogLevel, Parameter(group=Group(_OPTIONS_OF_ALL, sort_key=9), help=_LOG_LEVEL)
        ] = _DEFAULT_LEVEL,
    ) -> _Program:
        """Parse the command line."""
        function, arguments, _ = app.parse_args(words, exit_on_error=False, print_error=False)
        return partial(_run_logging, log_level, partial(function, *arguments.args, **arguments.kwargs))

    return app


def _shown_default(default: object) -> str | None:
    """A default as the help shows it; None where the option changes nothing unless it is given."""
    if default is None or default is False or default in ("", ()):
        return None
    return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)


def _run_logging(level: _LogLevel, program: _Program) -> int | None:
    from tfbus.cli.output import log_lines

    with log_lines(level.upper()):
        return program()

"""The help of the whole command: all subcommands and the options that they share.

It is laid out as cyclopts lays out the help of a subcommand, but without cyclopts, which takes longer to load than
people like to wait for a list.
"""

import shutil
import sys
from collections.abc import Mapping, Sequence

from tfbus.cli._width import wrapped

SUMMARY = "Stamped coordinate transforms for asyncio and trio."
INSTALL_COMPLETION = "Install completion for the shell that is in use, and exit."
COMMANDS = {
    "bridge": "Pass on all frames between FIRST and SECOND, both ways, until Ctrl-C.",
    "broadcast": "Broadcast the transform of the tutorial's laser, until Ctrl-C; tfbus listen in another terminal "
    "receives it.",
    "check": "Examine a recording, or a domain for some time, and say what is wrong, when, how often, and what to do.",
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
    "robot": "Publish the frames of a robot until Ctrl-C, or print them as a tree; joints without a position are at "
    "zero.",
    "router": "Pass on what programs of all domains send each other, until Ctrl-C.",
    "static": "Publish the static transform of CHILD in PARENT, or all that a file holds, until Ctrl-C.",
    "tree": "Show all frames as a tree, each with its rate, the age and span of its samples, and its authority.",
    "view": "Show the frames of a domain, or of a recording, as a live 3D page in the browser, until Ctrl-C.",
}
"""The first line of the help of each subcommand, so that a list of them loads none."""

EXIT_STATUSES = (
    "Exit status: 0 success; 1 a lookup or a recording has failed, or a check has found something; 2 wrong usage, or a "
    "file that cannot be used; 130 ended by Ctrl-C; 143 ended by a termination. Variables of the environment: "
    "TFBUS_DOMAIN, TFBUS_CONNECT (addresses with blanks between them), NO_COLOR."
)

_OPTIONS = {
    "--help (-h)": "Display this message and exit.",
    "--install-completion": INSTALL_COMPLETION,
    "--version": "Display application version.",
}
_OPTIONS_OF_ALL = {
    "--log-level CHOICE": "The least important log lines that are shown on standard error. [choices: debug, info, "
    "warning, error, critical] [default: warning]"
}


def asks_for_overview(words: Sequence[str]) -> bool:
    """Whether what a user types after ``tfbus`` asks for the help of the whole command."""
    return list(words) in ([], ["-h"], ["--help"])


def overview() -> str:
    """The help of the whole command, as wide as the terminal."""
    width = shutil.get_terminal_size((80, 24)).columns
    texts = [
        "Usage: tfbus COMMAND [OPTIONS]",
        SUMMARY,
        _panel("Commands", COMMANDS | _OPTIONS, width),
        _panel("Options of all commands", _OPTIONS_OF_ALL, width),
        "\n".join(wrapped(EXIT_STATUSES, width, 0)),
    ]
    text = "\n\n".join(texts)
    try:
        text.encode(sys.stdout.encoding or "ascii")
    except UnicodeEncodeError:
        text = text.translate(str.maketrans("╭╮╰╯─│", "++++-|"))
    return text


def _panel(title: str, rows: Mapping[str, str], width: int) -> str:
    """A box with a name and its meaning a row."""
    names = max(map(len, rows))
    room = max(width - names - 6, 8)
    lines = [
        f"│ {'' if number else name:{names}}  {line:{room}} │"
        for name, meaning in rows.items()
        for number, line in enumerate(wrapped(meaning, room, 0))
    ]
    rule = "─" * (names + room + 4)
    return "\n".join((f"╭─ {title} {rule[len(title) + 3 :]}╮", *lines, f"╰{rule}╯"))

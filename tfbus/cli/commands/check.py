"""``tfbus check``."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tfbus.cli.arguments import (
    Duration,
    Instant,
    JsonFlag,
    Positive,
    UsageError,
)
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import fitted, progress, say, warn
from tfbus.cli.recordings import DEFAULT_TOPICS, TopicOptions
from tfbus.cli.statuses import FAILED

with lazy_imports():
    from tfbus.analysis.examiner import Examiner, Finding, Limits
    from tfbus.bus.bus import Bus
    from tfbus.geometry.stamped import Batch
    from tfbus.recording.examine import examine

_SUFFIXES = (".mcap", ".bag", ".db3", ".active")


def check(
    what: str | None = None,
    /,
    *,
    since: Annotated[Instant | None, Parameter(name="--from")] = None,
    until: Annotated[Instant | None, Parameter(name="--to")] = None,
    duration: Duration = 10.0,
    max_translation: Positive = 1e8,
    max_speed: Positive = 100.0,
    max_turn_rate: Positive = 100.0,
    as_json: JsonFlag = False,
    topics: TopicOptions = DEFAULT_TOPICS,
    link: LinkOptions = DEFAULT_LINK,
) -> int:
    """Find faults in a recording, or in a domain for some time: which, when, how often, and what to do.

    The exit status is 0 if nothing is wrong and 1 if something is, such as a recording that is cut or unfinished. A
    frame that never moves is only a hint.

    Example: tfbus check run.mcap

    Parameters
    ----------
    what
        A recording, or the name of a domain; without it, the domain of --domain, or ROS with --ros.
    since
        For a recording, where to start: seconds from the beginning, a stamp in seconds, or a date.
    until
        For a recording, where to stop, in the same ways.
    duration
        For a domain, how many seconds to listen, from the first transform on.
    max_translation
        The longest possible translation, in m.
    max_speed
        The highest possible speed of a frame in its parent, in m/s.
    max_turn_rate
        The highest possible angular speed of a frame in its parent, in rad/s.
    as_json
        Print a JSON list of findings instead.
    """
    limits = Limits(translation=max_translation, speed=max_speed, turn_rate=max_turn_rate)
    file = None if what is None else Path(what)
    if file is not None and (file.exists() or file.suffix in _SUFFIXES):
        findings = _check_file(file, topics, limits, since, until)
    elif since is not None or until is not None:
        missing = "none is given" if what is None else f"there is no file {what!r}"
        raise UsageError(f"--from and --to are for recordings, and {missing}")
    elif what is not None and link.ros:
        raise UsageError(f"--ros joins ROS in place of a domain: leave {what!r} out")
    else:
        domain = link.domain if what is None else what
        link = replace(link, domain=domain, odometry=topics.odometry, invert=topics.invert)
        findings = _check_domain(link, limits, duration)
    if as_json:
        print(json.dumps([{**asdict(finding), "advice": finding.advice} for finding in findings], indent=2))
    else:
        _print(findings)
    return 0 if all(finding.is_hint for finding in findings) else FAILED


def _check_file(
    file: Path, topics: TopicOptions, limits: Limits, since: Instant | None, until: Instant | None
) -> list[Finding]:
    with topics.open(file) as recording, progress(recording.count, "reading") as advance:
        start = recording.start
        first = None if since is None else since.stamp(start)
        last = None if until is None else until.stamp(start)
        findings = examine(recording, limits, first, last, progress=advance)
        for remark in recording.remarks:
            warn(remark)
    return findings


def _check_domain(link: LinkOptions, limits: Limits, duration: float) -> list[Finding]:
    async def listen(bus: Bus) -> list[Finding]:
        examiner = Examiner(limits)

        def note(batch: Batch) -> None:
            examiner.add(batch, bus.clock.now())

        with bus.subscribe(note):
            await link.first_transform(bus)
            say(f"listening to {link.place} for {duration:g} s")
            await bus.clock.sleep(duration)
        return examiner.findings()

    return link.run(listen)


def _print(findings: Sequence[Finding]) -> None:
    if not findings:
        print("nothing is wrong")
    for finding in findings:
        for line in (f"{finding.kind:<16}  {finding}", f"{'':16}  -> {finding.advice}"):
            print(fitted(line, 18))

"""Those who ask a crowd's buffers: lookups, watches and message filters, at random and cut short at random."""

import math
from collections.abc import AsyncIterator
from functools import partial
from random import Random
from typing import Any, NamedTuple

import anyio
from support.asking import Asked
from support.crowd import FRAMES, Crowd

from tfbus import LATEST, ClockResetError, Hold, MessageFilter, PointStamped, from_seconds


class SourceError(Exception):
    """The error that a source of messages raises."""


class Message(NamedTuple):
    number: int
    frame: str
    stamp: int


def policy(rng: Random) -> dict[str, Any]:
    kind = rng.choice(("none", "none", "tolerance", "max_gap", "extrapolate"))
    seconds = rng.uniform(0.0, 0.4)
    return {} if kind == "none" else {kind: Hold(seconds) if kind == "extrapolate" else seconds}


def longest_hold(rng: Random) -> float:
    """In s; now and then there is no end to it."""
    return math.inf if rng.random() < 0.1 else rng.uniform(0.0, 4.0)


async def look_up(crowd: Crowd, rng: Random) -> None:
    buffer = rng.choice(crowd.buffers)
    target, source, fixed = rng.sample(FRAMES, 3)
    if rng.random() < 0.02:
        target = "/" + target
    at, source_at = (crowd.clock.now() + from_seconds(rng.uniform(-2.0, 0.5)) for _ in range(2))
    options = {**policy(rng), "timeout": rng.choice((None, 0.0, 0.2, 2.0))}
    kind = rng.choice(("at", "at", "latest", "travel", "data", "data travel"))
    if kind in ("data", "data travel"):
        point = PointStamped(source, rng.choice((source_at, LATEST)), (1.0, 0.0, 0.0))
        if kind == "data travel":
            options |= {"at": at, "fixed": fixed}
        moved = await buffer.transform(point, target, **options)
        assert moved.frame == target
        return
    if kind == "latest":
        found = await buffer.lookup(target, source, max_age=rng.choice((None, 0.2)), **options)
    else:
        if kind == "travel":
            options |= {"source_at": source_at, "fixed": fixed}
        found = await buffer.lookup(target, source, at, **options)
        assert found.stamp == at
    assert (found.parent, found.child) == (target, source)


async def ask(crowd: Crowd, rng: Random) -> None:
    async with anyio.create_task_group() as tasks:
        while crowd.going:
            crowd.asked.append(Asked(tasks, partial(look_up, crowd, Random(rng.random()))))
            if rng.random() < 0.3:
                rng.choice(crowd.asked[-20:]).cancel()
            await crowd.pause(rng, 0.15)


async def watch(crowd: Crowd, rng: Random) -> None:
    while crowd.going:
        target, source = rng.sample(FRAMES, 2)
        options = {**policy(rng), "max_age": rng.choice((None, 0.5)), "max_rate": rng.choice((None, 5.0))}
        changes = rng.choice(crowd.buffers).watch(target, source, min_translation=rng.choice((0.0, 0.1)), **options)
        with changes, crowd.clock.move_on_after(longest_hold(rng)):
            for _ in range(3):
                try:
                    async for found in changes:
                        assert (found.parent, found.child) == (target, source)
                        crowd.met["watched"] += 1
                        await crowd.pause(rng, 0.4)
                except ClockResetError:
                    crowd.met["watch reset"] += 1
        await crowd.pause(rng, 0.2)


async def messages(crowd: Crowd, rng: Random, sent: list[Message]) -> AsyncIterator[Message]:
    while True:
        await crowd.pause(rng, 0.1)
        if rng.random() < 0.03:
            raise SourceError
        stamp = crowd.clock.now() + from_seconds(rng.uniform(-2.0, 0.5))
        sent.append(Message(len(sent), rng.choice((*FRAMES, "nobody", "/bad")), stamp))
        yield sent[-1]


async def filter_messages(crowd: Crowd, rng: Random) -> None:
    sent: list[Message] = []
    ended: list[Message] = []

    def drop(message: Message, reason: str, error: Exception | None) -> None:
        assert reason == "queue full" or error is not None or reason == "closed"
        ended.append(message)

    while crowd.going:
        await crowd.pause(rng, 0.2)
        targets: Any = rng.choice(("map", ("map", "base")))
        pairs: MessageFilter[Message, Any] = MessageFilter(
            messages(crowd, rng, sent),
            rng.choice(crowd.buffers),
            targets,
            tolerance=rng.choice((0.0, 0.1)),
            timeout=rng.choice((None, 0.0, 0.2, 1.0)),
            capacity=rng.randint(1, 6),
            overflow=rng.choice(("drop_oldest", "drop_newest", "block")),
            order=rng.choice(("ready", "stamp", "arrival")),
            on_drop=drop,
        )
        crowd.filters.append(pairs)
        try:
            with crowd.clock.move_on_after(longest_hold(rng)):
                async with pairs:
                    async for message, _ in pairs:
                        ended.append(message)
                        if rng.random() < 0.1:
                            pairs.set_target("odom" if targets == "map" else ("odom", "map"))
                        await crowd.pause(rng, 0.3)
        except SourceError:
            crowd.met["source failed"] += 1
        finally:
            assert sorted(ended) == sent
            assert pairs.arrived == pairs.delivered + sum(pairs.dropped.values())
            crowd.met.update(pairs.dropped)
            crowd.met["delivered"] += pairs.delivered
            sent.clear()
            ended.clear()

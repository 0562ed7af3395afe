import json

import anyio
import anyio.to_thread
import pytest
from support.commands import Command
from support.processes import new_domain, start_tfbus
from support.samples import moving, static

from tfbus import SECOND, Buffer, Bus, LocalLink, Transform, TransformStamped
from tfbus.cli.commands.echo import describe, to_json
from tfbus.cli.replay_clock import ReplayClock
from tfbus.links import BufferServer

MOVING = TransformStamped(
    "map", "base_link", 1_700_000_000_000_000_001, Transform.from_xyz_rpy((1, -2, 0.5), (0, 0, -0.5))
)


def test_a_transform_is_printed_as_by_tf2_echo_with_its_age_and_both_frames() -> None:
    # sin(0.25) = 0.247404, cos(0.25) = 0.968912, and 0.5 rad are 28.647890 degrees.
    assert describe(MOVING, MOVING.stamp + SECOND // 4).split("\n") == [
        "At 1700000000.000000001 s, age 250 ms: 'base_link' in 'map'",
        "- Translation: [1.000000, -2.000000, 0.500000] m",
        "- Rotation: in quaternion (xyzw) [0.000000, 0.000000, -0.247404, 0.968912]",
        "            in rpy (rad)          [0.000000, 0.000000, -0.500000]",
        "            in rpy (deg)          [0.000000, 0.000000, -28.647890]",
    ]


def test_json_has_the_stamp_as_an_integer_and_the_age_in_seconds_and_a_static_transform_has_none() -> None:
    line = to_json(MOVING, MOVING.stamp + SECOND // 4)
    assert "\n" not in line
    place = {"translation": [1.0, -2.0, 0.5], "rotation": list(MOVING.transform.rotation)}
    moving_facts = {"stamp": 1_700_000_000_000_000_001, "static": False, "age": 0.25}
    assert json.loads(line) == {"target": "map", "source": "base_link", **place, **moving_facts}
    still = MOVING.replace(static=True)
    assert json.loads(to_json(still, 0))["age"] is None
    assert describe(still, 0).startswith("At any time: 'base_link' in 'map'\n")


@pytest.mark.parametrize("backend", ["asyncio", "trio"])
def test_it_says_once_what_is_missing_and_prints_as_soon_as_nothing_is(tfbus: Command, backend: str) -> None:
    async def publish(bus: Bus) -> None:
        # At 102 s, one of the two frames appears; at 105.25 s, the other one.
        await bus.clock.sleep(2.0)
        bus.publish(moving("base", "laser", bus.clock.now(), 1.0))
        await bus.clock.sleep(3.25)
        bus.publish(static("base", "camera", 3.0))
        await bus.clock.sleep(5.0)

    options = ("--json", "--max-age", "4", "--rate", "2", "--domain", "yard", "--backend", backend)
    done = tfbus.on_domain(publish, "echo", "camera", "laser", *options)
    assert done.returncode == 130
    assert done.stderr.splitlines() == [
        "waiting for transforms on domain 'yard' …",
        "waiting for 'laser' in 'camera': frame 'camera' is not known",
        "waiting for 'laser' in 'camera': frame 'laser': newest sample is 5.5 s old, and may be 4 s old (max_age)",
    ]
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    # From 106 s on, the sample of 102 s is older than 4 s: the lookup of 106.5 s fails a second later.
    assert [answer["age"] for answer in answers] == [3.25, 3.5, 4.0]
    assert {(answer["stamp"], *answer["translation"]) for answer in answers} == {(102 * SECOND, -2.0, 0.0, 0.0)}


def test_a_missing_transform_is_reported_again_after_it_was_there(tfbus: Command) -> None:
    async def publish(bus: Bus) -> None:
        await bus.clock.sleep(0.5)
        for _ in range(2):
            bus.publish(moving("base", "laser", bus.clock.now()))
            await bus.clock.sleep(4.9)

    done = tfbus.on_domain(publish, "echo", "base", "laser", "--max-age", "0.5")
    # The lookups of 101.5 s and 106.5 s fail first, a second later; the next ones fail silently.
    assert [line.partition(" (")[0] for line in done.stderr.splitlines()] == [
        "waiting for 'laser' in 'base': frame 'laser': newest sample is 2 s old, and may be 500 ms old",
        "waiting for 'laser' in 'base': frame 'laser': newest sample is 2.1 s old, and may be 500 ms old",
    ]


def test_a_static_transform_is_printed_again_and_again(tfbus: Command) -> None:
    async def publish(bus: Bus) -> None:
        bus.publish(static("base_link", "laser"))
        await bus.clock.sleep(2.5)

    done = tfbus.on_domain(publish, "echo", "laser", "base_link")
    assert done.stdout.splitlines()[::5] == ["At any time: 'base_link' in 'laser'"] * 3


@pytest.mark.parametrize("heard", [False, True])
@pytest.mark.parametrize("option", [(), ("--json",)])
def test_no_age_is_shown_and_nothing_is_told_before_the_time_of_a_simulation_is_heard(
    tfbus: Command, option: tuple[str, ...], heard: bool
) -> None:
    clock = ReplayClock()
    if heard:
        clock.hear(100 * SECOND + SECOND // 20)

    async def publish(bus: Bus) -> None:
        for _ in range(20):
            bus.publish(moving("map", "base", 100 * SECOND))
            await anyio.sleep(0.01)

    done = tfbus.on_domain(publish, "echo", "map", "base", "--rate", "50", *option, clock=clock)
    if option:
        ages = {json.loads(line)["age"] for line in done.stdout.splitlines()}
        assert ages == {0.05 if heard else None}
    else:
        lines = {line for line in done.stdout.splitlines() if line.startswith("At")}
        assert lines == {f"At 100.000000000 s, {'age 50 ms' if heard else 'age not known'}: 'base' in 'map'"}
    assert "behind" not in done.stderr


@pytest.mark.thorough
def test_remote_transforms_come_from_the_buffer_of_another_program() -> None:
    domain = new_domain()
    options = ("--remote", "--rate", "5", "--json", "--domain", domain)

    async def serve() -> None:
        with Bus() as bus, Buffer(bus) as buffer:
            async with LocalLink(bus, domain, robot="r1") as link, BufferServer(buffer, link):
                bus.publish(static("map", "base", 2.0))
                with start_tfbus("echo", "map", "base", *options, "--robots", "r1") as echo:
                    line = await anyio.to_thread.run_sync(echo.output.expect, "translation")
                    assert json.loads(line)["translation"] == [2.0, 0.0, 0.0]
                    assert echo.end() == 130
                with start_tfbus("echo", "map", "base", *options) as echo:
                    missing = await anyio.to_thread.run_sync(echo.errors.expect, "waiting")
                    assert missing.endswith(f"a buffer without a robot in domain '{domain}': nobody offers it")
                    assert echo.end() == 130

    anyio.run(serve)


def test_numbers_and_frames_are_on_lines_of_their_own_where_they_do_not_fit() -> None:
    long = MOVING.replace(child="a_frame_with_a_very_long_name_of_a_part_of_a_part_of_a_robot")
    for sample, width, lines in ((MOVING, 59, 8), (long, 50, 10)):
        shown = describe(sample, MOVING.stamp + SECOND // 4, width).split("\n")
        assert max(map(len, shown)) <= width
        assert len(shown) == lines
        assert "  [0.000000, 0.000000, -0.247404, 0.968912]" in shown

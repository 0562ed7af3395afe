import json
import re

import pytest
from support.commands import Command
from support.samples import moving, static

from tfbus import SECOND, Bus, Covariance, PeerClock, Transform, UncertainSample
from tfbus.analysis import Arrivals
from tfbus.cli.commands.monitor import Chain, text_lines, to_document


async def publish(bus: Bus) -> None:
    """An arm at 10 Hz, 20 ms late, on a base at 2 Hz, and a camera that is static."""
    bus.publish(static("arm", "camera", authority="urdf"))
    async for tick in bus.clock.ticks(10.0):
        now = bus.clock.now()
        bus.publish(moving("base", "arm", now - SECOND // 50, authority="joints"))
        if tick % 5 == 0:
            bus.publish(moving("map", "base", now, authority="odometry"))


def test_each_frame_and_sender_is_a_line(tfbus: Command) -> None:
    done = tfbus.on_domain(publish, "monitor", "--once", "--duration", "3.04")
    assert (done.returncode, done.stderr) == (0, "")
    titles, arm, base, camera = done.stdout.splitlines()
    head = ["frame", "sender", "rate", "delay least", "mean", "p99", "max", "jitter", "longest gap", "late", "lost"]
    assert re.split("  +", titles) == head
    assert arm.split() == "arm joints 10.0 Hz 20 ms 20 ms 20 ms 20 ms 0 ns 100 ms 0 0".split()  # noqa: SIM905 - as printed
    assert base.split()[:4] == ["base", "odometry", "2.0", "Hz"]
    assert camera.split() == ["camera", "urdf", "static"]


def test_of_a_pair_the_way_and_its_slowest_frame_are_shown(tfbus: Command) -> None:
    done = tfbus.on_domain(publish, "monitor", "map", "camera", "--once", "--duration", "3.04")
    way, empty, *table = done.stdout.splitlines()
    # The newest stamp of both moving frames is that of the base at 3 s.
    assert way.startswith("map <- base <- arm <- camera: age ")
    assert way.endswith(", the slowest is base")
    assert empty == ""
    assert [line.split()[0] for line in table] == ["frame", "arm", "base", "camera"]
    done = tfbus.on_domain(publish, "monitor", "arm", "camera", "--once")
    assert done.stdout.splitlines()[0] == "arm <- camera: static"
    done = tfbus.on_domain(publish, "monitor", "map", "camra", "--once")
    assert done.stdout.startswith("no transform: frame 'camra' is not known, did you mean 'camera'?\n\n")


def test_frames_with_a_covariance_show_two_sigmas_in_their_least_sure_direction(tfbus: Command) -> None:
    matrix = Covariance.of(rpy=(0.0, 0.0, 0.1)).matrix.copy()
    # Equal along both axes, and 20 mm along the diagonal between them.
    matrix[:2, :2] = [[2.5e-4, 1.5e-4], [1.5e-4, 2.5e-4]]
    error, mount = Covariance(matrix), Covariance.of(xyz=0.6)

    async def publish_errors(bus: Bus) -> None:
        bus.publish(UncertainSample("arm", "camera", 0, Transform(), "urdf", static=True, covariance=mount))
        async for _ in bus.clock.ticks(10.0):
            now = bus.clock.now()
            bus.publish(moving("map", "base", now, authority="slam"))
            bus.publish(UncertainSample("base", "arm", now, Transform(), "joints", covariance=error))

    done = tfbus.on_domain(publish_errors, "monitor", "--once", "--duration", "1.04")
    titles, arm, base, camera = done.stdout.splitlines()
    assert re.split("  +", titles)[:5] == ["frame", "sender", "rate", "2 sigma", "delay least"]
    assert "40 mm, 11 deg" in arm
    assert "deg" not in base
    assert camera.split() == ["camera", "urdf", "static", "1.2", "m,", "0", "deg"]
    done = tfbus.on_domain(publish_errors, "monitor", "--once", "--json", "--duration", "1.04")
    frames = {frame["frame"]: frame.get("sigmas") for frame in json.loads(done.stdout)["frames"]}
    assert frames == {"arm": pytest.approx(error.sigmas), "base": None, "camera": pytest.approx(mount.sigmas)}


def test_it_is_printed_again_and_again_as_json_too(tfbus: Command) -> None:
    async def publish_for_a_while(bus: Bus) -> None:
        with bus.clock.move_on_after(2.05):
            await publish(bus)

    done = tfbus.on_domain(publish_for_a_while, "monitor", "map", "arm", "--json", "--window", "1")
    assert done.returncode == 130
    documents = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(documents) == 3
    last = documents[-1]
    assert (last["window"], last["chain"]["frames"], last["chain"]["slowest"]) == (1.0, ["map", "base", "arm"], "base")
    assert [(frame["frame"], frame["rate"], frame["late"]) for frame in last["frames"]] == [
        ("arm", pytest.approx(10.0), 0),
        ("base", pytest.approx(2.0), 0),
    ]
    done = tfbus.on_domain(publish_for_a_while, "monitor", "--rate", "1")
    assert done.stdout.count("frame ") == 3


def test_peers_and_senders_whose_clocks_differ_have_tables() -> None:
    arrivals = Arrivals(10.0)
    for authority, ahead in (("odometry", 300), ("slam", 300), ("simulation", -(10**12)), ("good", -5)):
        arrivals.note((moving("map", f"by {authority}", ahead * 10**6, authority=authority),), 0)
    clocks = [PeerClock("7d4f" * 8, ("odometry",), 0.31, 0.0002, 1.5e-6, 0.0004), PeerClock("ab" * 16, runs=False)]
    lines = list(text_lines(arrivals.measure(0), None, None, clocks))
    blank = lines.index("")
    assert [re.split("  +", line) for line in lines[blank + 1 :]] == [
        ["peer", "senders", "clock ahead by", "within", "drift", "round trip"],
        ["7d4f7d4f", "odometry", "310 ms", "200 us", "1.5 us/s", "400 us"],
        ["abababab", "simulated"],
        [""],
        ["sender", "least delay", "its clock"],
        ["simulation", "31.7 years", "another clock (simulated?)"],
        ["slam", "-300 ms", "its clock is at least 300 ms ahead of this one"],
    ]
    document = to_document(arrivals.measure(0), None, 10.0, clocks, {})
    assert [clock["offset"] for clock in document["clocks"]] == [0.31, None]
    assert {one["authority"]: one["delay"] for one in document["senders"]}["good"] == 0.005


def test_the_way_between_two_frames_is_folded_and_indented_on_a_narrow_terminal() -> None:
    chain = Chain([f"frame_{number}" for number in range(9)], "frame_3", 0.25, "")
    (whole, blank, none), (first, *others) = (list(text_lines([], chain, width)) for width in (None, 40))
    assert (blank, none) == ("", "(no frames)")
    assert whole.startswith("frame_0 ")
    assert first.startswith("frame_0 ")
    folded = others[: others.index("")]
    assert len(folded) > 1
    assert all(line.startswith("  ") and line[2] != " " for line in folded)
    assert " ".join([first, *(line.strip() for line in folded)]) == whole

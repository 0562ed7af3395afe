"""Programs that fork: a child has the copy of a bus, and none of the threads and loops that work for it."""

import subprocess
import sys
from importlib.util import find_spec

import pytest
from support.processes import new_dds_domain, new_domain

BEGIN = """
import asyncio, multiprocessing, os, sys, tempfile
import anyio
from tfbus import Buffer, Bus, LocalLink, TransformBroadcaster, Transform, TransformStamped
from tfbus.links import BufferServer
from tfbus.links.zenoh import ZenohLink, ZenohRouter
from tfbus.recording import Recorder

def sample(stamp):
    return TransformStamped("map", "base", stamp, Transform((float(stamp), 0.0, 0.0)))

def tell(do, *arguments):
    try:
        print("did", do(*arguments))
    except Exception as error:
        print(type(error).__name__, error)

def in_a_child(body):
    child = os.fork()
    if child == 0:
        body()
        sys.stdout.flush()
        os._exit(0)
    os.waitpid(child, 0)

def in_a_process(body):
    process = multiprocessing.get_context("fork").Process(target=body)
    process.start()
    process.join()
"""


def said(program: str) -> list[str]:
    command = [sys.executable, "-P", "-W", "ignore::DeprecationWarning", "-c", BEGIN + program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_a_child_may_use_its_copy_of_a_bus_that_only_buffers_and_callbacks_are_on_and_links_of_its_own() -> None:
    lines = said("""
bus = Bus(max_ahead=None, max_behind=None)
buffer = Buffer(bus)
bus.publish([sample(1), sample(3)])
def child():
    with bus.subscribe(lambda batch: print("heard", batch[-1].stamp)):
        tell(bus.publish, sample(5))
    print(buffer.lookup_nowait("map", "base", 4).transform.translation)
    tell(bus.remove_frame, "base")
in_a_child(child)
# The parent's is another one.
print(buffer.lookup_nowait("map", "base").stamp)

async def enter():
    with Bus(max_behind=None) as bus:
        async with ZenohLink(bus, listen="tcp/127.0.0.1:0") as link:
            print(link.peers)
in_a_child(lambda: tell(anyio.run, enter))
anyio.run(enter)
""")
    assert lines == ["heard 5", "did None", "(4.0, 0.0, 0.0)", "did None", "3", "()", "did None", "()"]


ENTERED = {
    "LocalLink": "LocalLink(bus, directory=tempfile.mkdtemp())",
    "ZenohLink": "ZenohLink(bus, listen='tcp/127.0.0.1:0')",
    "Recorder": "Recorder(bus, tempfile.mkdtemp() + '/a.tfbus')",
}


@pytest.mark.parametrize(
    "started", ["in_a_child(child)", pytest.param("in_a_process(child)", marks=pytest.mark.thorough)]
)
def test_a_child_is_told_that_nobody_hears_what_it_publishes_on_the_bus_of_its_parent(started: str) -> None:
    lines = said(f"""
async def main(kind):
    with Bus(max_ahead=None, max_behind=None) as bus, Buffer(bus) as buffer:
        one, two = TransformBroadcaster(bus), eval(kind)
        def child():
            # It has what it had heard before the fork.
            print(buffer.lookup_nowait("map", "base").stamp)
            tell(bus.publish, sample(2))
            tell(bus.publish, [sample(2), sample(3)])
            tell(one.send_static, "map", "lamp", Transform())
            tell(bus.remove_frame, "base")
            tell(bus.subscribe, print)
            with Bus(max_behind=None) as own:
                tell(own.publish, sample(2))
        async with two:
            bus.publish(sample(1))
            {started}
            tell(bus.publish, sample(2))
        # Nothing works for it any more.
        in_a_child(lambda: tell(bus.publish, sample(3)))

for kind in {list(ENTERED.values())}:
    anyio.run(main, kind)
""")
    for kind in ENTERED:
        first, *refused = lines[:6]
        assert first == "1"
        for line in refused:
            assert line.startswith(
                f"RuntimeError this process was forked, and fork has not copied what works for the bus, {kind}"
            )
            assert "'spawn' of multiprocessing" in line
        assert lines[6:9] == ["did None"] * 3
        del lines[:9]
    assert lines == []


@pytest.mark.thorough
def test_a_child_cannot_use_the_threads_and_links_of_its_parent_nor_enter_one_of_zenoh() -> None:
    lines = said(f"""
async def enter(link):
    async with link:
        print("entered")

async def main():
    with Bus(max_ahead=None, max_behind=None) as bus:
        with bus.threadsafe() as publish:
            in_a_child(lambda: tell(publish, sample(1)))
            in_a_child(lambda: tell(bus.publish, sample(1)))
            tell(publish, sample(2))
        async with LocalLink(bus, {new_domain()!r}) as link:
            in_a_process(lambda: tell(asyncio.run, link.lookup("map", "base")))
        async with ZenohLink(bus, listen="tcp/127.0.0.1:0") as link:
            in_a_process(lambda: tell(asyncio.run, link.lookup("map", "base")))
            own = Bus(max_behind=None)
            in_a_process(lambda: tell(asyncio.run, enter(ZenohLink(own, listen="tcp/127.0.0.1:0"))))
anyio.run(main)
""")
    assert [line.partition(":")[0] for line in lines[:3]] == [
        *["RuntimeError this process was forked, and fork has not copied what works for the bus, ThreadPublisher"] * 2,
        "did None",
    ]
    assert [line.partition(",")[0] for line in lines[3:]] == [
        *["RuntimeError this process was forked"] * 2,
        "RuntimeError this process was forked from one that uses zenoh",
    ]


def test_a_link_that_was_made_before_the_fork_is_entered_by_the_parent_alone() -> None:
    # The copies would have one id, and the copies of the bus one origin: they would not hear each other.
    lines = said("""
async def enter(link):
    async with link:
        pass

bus = Bus(max_behind=None)
link = LocalLink(bus, directory=tempfile.mkdtemp())
in_a_child(lambda: tell(anyio.run, enter, link))
in_a_child(lambda: tell(anyio.run, enter, LocalLink(bus, directory=tempfile.mkdtemp())))
tell(anyio.run, enter, link)
""")
    assert [line.partition(":")[0] for line in lines] == [
        *["RuntimeError this process was forked since a link of the bus was made"] * 2,
        "did None",
    ]


def test_a_child_cannot_join_a_domain_of_dds_that_its_parent_has_open() -> None:
    pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')
    lines = said(f"""
from tfbus.links.dds import DdsLink
async def main():
    async with DdsLink(Bus(), {new_dds_domain()}) as link:
        async def enter():
            with anyio.fail_after(10.0):
                await DdsLink(Bus(), link.domain).__aenter__()
        await anyio.to_thread.run_sync(in_a_process, lambda: tell(anyio.run, enter))
anyio.run(main)
""")
    (line,) = lines
    assert line.startswith("RuntimeError this process was forked from one that has the DDS domain ")


@pytest.mark.thorough
def test_a_child_of_a_program_with_a_local_link_meets_it_and_the_parent_has_it_still() -> None:
    lines = said("""
async def meet(link):
    async with link:
        while not link.peers:
            await anyio.sleep(0.01)
        print(len(link.peers))

async def main():
    directory = tempfile.mkdtemp()
    with Bus(max_behind=None) as bus, Bus() as other:
        async with LocalLink(bus, directory=directory) as link, LocalLink(other, directory=directory):
            child = multiprocessing.get_context("fork").Process(
                target=lambda: tell(asyncio.run, meet(LocalLink(Bus(max_behind=None), directory=directory)))
            )
            child.start()
            await anyio.to_thread.run_sync(child.join)
            while len(link.peers) > 1:
                await anyio.sleep(0.01)
            print(len(link.peers))
            with bus.events() as events:
                print([type(event).__name__ for event in iter(events.queue.get, None)])
anyio.run(main)
""")
    assert lines[1:] == ["did None", "1", "[]"]
    assert lines[0] in "12"


def test_each_object_that_was_made_and_never_entered_is_told_of_in_one_line_and_no_other() -> None:
    # The live page needs an extra of its own.
    view = ["View"] if find_spec("trimesh") and find_spec("collada") else []
    program = f"""{BEGIN}
from tfbus.links.rmw_zenoh import RmwZenohLink
from tfbus.links.rosbridge import RosbridgeLink, RosbridgeServer
from tfbus import MessageFilter, Synchronizer
async def messages():
    yield
async def enter(link):
    async with link:
        pass
entered = ZenohLink(Bus(), listen="tcp/127.0.0.1:0")
anyio.run(enter, entered)
tell(anyio.run, enter, ZenohLink(Bus(), listen="tcp/192.0.2.1:1"))
tell(ZenohLink, Bus(), "no domain")
# One link goes at once, the program keeps the others to its end; the copies in a child are not told of again.
RmwZenohLink(Bus())
link = LocalLink(Bus())
kept = [ZenohLink(Bus(), connect="tcp/127.0.0.1:1"), RosbridgeLink(Bus(), "ws://127.0.0.1:9090"), link]
buffer = Buffer(link.bus)
kept += [BufferServer(buffer, link), ZenohRouter("tcp/127.0.0.1:1"), RosbridgeServer(link.bus)]
kept += [Recorder(link.bus, "never"), MessageFilter(messages(), buffer, "map")]
kept += [Synchronizer(messages(), messages(), within=1.0)]
if {view}:
    from tfbus.view import View
    kept += [View(link.bus, buffer)]
in_a_child(lambda: sys.exit())
"""
    command = [sys.executable, "-P", "-W", "ignore::DeprecationWarning", "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["OSError", "ValueError"]
    assert sorted(done.stderr.splitlines()) == [
        f"a {name} was made and never entered, so it has done nothing: write `async with {name}(...)`"
        for name in (
            *("BufferServer", "LocalLink", "MessageFilter", "Recorder", "RmwZenohLink", "RosbridgeLink"),
            *("RosbridgeServer", "Synchronizer", *view, "ZenohLink", "ZenohRouter"),
        )
    ]

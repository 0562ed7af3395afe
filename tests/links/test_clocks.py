"""The clocks of peers: they are measured within their bounds, told, and corrected once, whatever the network does."""

import pickle
import random
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.domains import SECOND, Network, Process, SkewedClock, World
from support.foreign_world import ForeignWorld
from support.samples import moving, static

from tfbus import (
    Buffer,
    Bus,
    ClockOffset,
    FutureExtrapolationError,
    LocalLink,
    PeerClock,
    PeerClockStepped,
    PeerJoined,
    SimulatedClock,
    SystemClock,
    Transform,
    TransformBroadcaster,
    format_stamp,
)
from tfbus.links.clocks import (
    MOST_ECHOES,
    STEP,
    TOLERANCE,
    ClockFilter,
    Clocks,
    OwnClock,
    read_section,
    split_section,
    write_section,
)

# The filter


@given(
    ahead=st.integers(-(10**18), 10**18),
    drift=st.floats(-TOLERANCE, TOLERANCE),
    rounds=st.lists(
        st.tuples(*[st.integers(0, SECOND // 2)] * 2, *[st.integers(0, 6 * SECOND)] * 2), min_size=1, max_size=50
    ),
    later=st.integers(0, 600 * SECOND),
)
@example(ahead=0, drift=TOLERANCE, rounds=[(SECOND // 10, 0, 6 * SECOND, 0)], later=0)
def test_the_true_offset_is_within_the_bound_whatever_the_delays_of_both_directions(
    ahead: int, drift: float, rounds: list[tuple[int, int, int, int]], later: int
) -> None:
    def theirs(own: int) -> int:
        return ahead + own + round(own * drift)

    def check(now: int) -> None:
        found, smooth = measured.ahead(now), measured.smoothly_ahead(now)
        assert found is not None
        assert smooth is not None
        assert abs(found[0] - (theirs(now) - now)) <= found[1] + 3
        assert abs(smooth - found[0]) <= found[1]

    measured, now = ClockFilter(), 0
    for there, back, held, pause in rounds:
        sent, heard = now, now + there
        answered, arrived = heard + held, heard + held + back
        measured.note(sent, theirs(heard), theirs(answered), arrived)
        check(arrived)
        now = arrived + pause
    check(now + later)


def test_the_exchange_of_the_lowest_round_trip_is_believed_until_it_is_too_old() -> None:
    measured = ClockFilter()
    measured.note(0, 1_000, 1_000, 2_000)
    measured.note(SECOND, SECOND + 50_000_000, SECOND + 50_000_000, SECOND + 50_000_100)
    assert measured.ahead(SECOND + 50_000_100) == (0, 1_001 + round(TOLERANCE * (SECOND + 50_000_100 - 1_000)))
    late = 500 * SECOND
    measured.note(late, late + 50_000_000, late + 50_000_000, late + 50_000_100)
    found = measured.ahead(late)
    assert found is not None
    assert found[0] == 24_999_950


def test_a_steady_clock_that_has_stopped_for_a_while_is_measured_anew() -> None:
    measured = ClockFilter()
    measured.note(0, 1_000, 1_000, 2_000)
    # The first one has the smaller bound.
    measured.note(SECOND, 1_000, 2_000, SECOND + 1_000_000)
    found = measured.ahead(SECOND)
    assert found is not None
    assert found[0] == pytest.approx(-SECOND, abs=1_000_000)


def test_times_that_no_clocks_can_make_are_left_out() -> None:
    measured = ClockFilter()
    for times in ((0, 0, SECOND, 10), (0, 5, 0, 10), (10, 5, 6, 0)):
        measured.note(*times)
    assert measured.ahead(0) is None


@example(write_section(2**62, 0, [(bytes(8), 0, 2**62)]), 2**62)
@given(
    st.binary(max_size=100)
    | st.builds(
        write_section,
        st.integers(-(2**63), 2**63 - 1),
        *[
            st.integers(-(2**63), 2**63 - 1),
            st.lists(st.tuples(st.just(bytes(8)), *[st.integers(-(2**63), 2**63 - 1)] * 2), max_size=2),
        ],
    ),
    st.integers(-(2**63) + 1, 2**63 - 1),
)
def test_no_section_of_a_stranger_does_harm(data: bytes, told: int) -> None:
    clocks = Clocks(OwnClock(SystemClock()), "0" * 32, 0.02)
    clocks.corrects = True
    clocks.joined("a" * 32)
    clocks.joined("no hexadecimal digits")
    for _ in range(3):
        section = split_section(data)[1]
        if section:
            for peer in ("a" * 32, "b" * 32, "no hexadecimal digits"):
                clocks.arrive(peer, section)
        assert len(clocks.section(answers=True)) < 100
        list(clocks.news())
        assert len(clocks.statistics([("a" * 32, ())])) == 1
        clock, shift = clocks.place("a" * 32, told)
        assert clock is None or -(2**63) < clock < 2**63
        assert abs(shift) < 2**65
        clocks.jumps("a" * 32, b"origin", told, clock, shift)
    clocks.left("a" * 32)
    assert clocks.statistics([("a" * 32, ())]) == ()


def test_a_reading_that_was_interrupted_is_repeated_and_the_quickest_is_believed() -> None:
    time, pauses = 0, iter((SECOND, 200_000, SECOND // 2, SECOND // 2))

    class Interrupted(SystemClock):
        def now(self) -> int:
            nonlocal time
            time += next(pauses)
            return 5 * SECOND + time

    # A pause before a reading makes the base wrong by half of it.
    assert OwnClock(Interrupted(), lambda: time).base() == 5 * SECOND + 100_000


def test_each_sign_is_answered_once_and_one_sign_answers_so_many() -> None:
    clocks = Clocks(OwnClock(SystemClock()), "0" * 32, 0.02)
    links = [random.Random(number).randbytes(16) for number in range(MOST_ECHOES + 5)]
    for link in links:
        clocks.joined(link.hex())
        clocks.arrive(link.hex(), write_section(7, 0, ()))
    answered = [
        sum(read_section(section, link[:8]).echo is not None for link in links)
        for section in (clocks.section(answers=answers) for answers in (False, True, True, True))
    ]
    assert answered == [0, MOST_ECHOES, 5, 0]


def test_only_a_bus_whose_clock_runs_corrects_others_and_an_offset_is_a_duration() -> None:
    with pytest.raises(TypeError, match="the bus needs a clock that runs"):
        LocalLink(Bus(SimulatedClock()), correct_clocks=True)
    with pytest.raises(ValueError, match="max_offset must not be negative"):
        LocalLink(Bus(), max_offset=-1.0)


# Two processes and more, in simulated time


def publish(process: Process, frame: str, clock: SkewedClock, authority: str = "") -> None:
    """Send a frame that goes along x with 1 m/s of the world's time, stamped by the clock of its process."""
    broadcaster = TransformBroadcaster(process.bus, authority)
    broadcaster.send("map", frame, Transform((process.world.now, 0.0, 0.0)), at=clock.now())
    process.flush()


def clock_of(process: Process, other: Process) -> PeerClock:
    return next(clock for clock in process.end.clock_statistics() if clock.peer == other.wire.id)


def go(world: World, seconds: float, period: float, *sends: tuple[Process, str, SkewedClock]) -> None:
    for _ in range(round(seconds / period)):
        for send in sends:
            publish(*send)
        world.run(period)


@pytest.mark.parametrize(
    ("ahead", "drift"), [(0.02, 0.0), (-0.02, 100e-6), (0.3, 500e-6), (-0.3, 0.0), (3600.0, 100e-6)]
)
def test_the_offset_of_a_peer_and_its_drift_are_told_within_seconds_and_again_after_a_clock_was_set(
    ahead: float, drift: float
) -> None:
    world = World(3)
    network = Network(world)
    # Exchanges that take long say little.
    network.delay = lambda *_: 0.5 if world.random.random() < 0.05 else 0.001
    clock, own = SkewedClock(world, ahead, drift), SkewedClock(world)
    here = world.process(network, clock=own, max_offset=0.015)
    with here.bus.events() as events:
        there = world.process(network, clock=clock, max_offset=1e9)
        go(world, 5.0, 0.1, (there, "cart", clock))
        told = [event for event in iter(events.queue.get, None) if isinstance(event, ClockOffset)]
    assert [(event.peer, event.over) for event in told] == [(there.wire.id, False)]
    assert told[0].offset == pytest.approx(ahead, abs=0.003)
    changes = [(clock, "ahead", ahead + 1.0), (own, "ahead", -2.0)]
    changes += [(which, "is_set", is_set) for which in (clock, own) for is_set in (False, True)]
    for which, name, value in changes:
        setattr(which, name, value)
        go(world, 3.0, 0.5, (there, "cart", clock))
        assert clock_of(here, there).drift is None
        go(world, 20.0, 0.5, (there, "cart", clock))
        for one, other, sign in ((here, there, 1), (there, here, -1)):
            found = clock_of(one, other)
            if not (clock.is_set and own.is_set):
                assert (found.offset, found.drift) == (None, None)
                continue
            assert found.offset is not None
            assert found.bound is not None
            assert abs(found.offset - sign * (clock.offset - own.offset)) <= found.bound < 0.005
            assert found.drift == pytest.approx(sign * drift, abs=20e-6)


@pytest.mark.parametrize("minutes", [5, pytest.param(60, marks=pytest.mark.thorough)])
def test_no_offset_is_told_in_an_hour_of_delays_if_there_is_none(minutes: int) -> None:
    world = World(1)
    network = Network(world)
    draw = random.Random(5)
    network.delay = lambda *_: draw.choice((0.001, 0.02, draw.expovariate(10.0), draw.expovariate(1.0)))
    here, there = (world.process(network, clock=SkewedClock(world)) for _ in range(2))
    with here.bus.events() as events:
        go(world, 60.0 * minutes, 1.0, (there, "cart", there.bus.clock))  # type: ignore[arg-type]
        assert not [event for event in iter(events.queue.get, None) if isinstance(event, ClockOffset)]
    assert clock_of(here, there).bound is not None


def test_an_offset_is_told_again_when_it_changes_and_when_it_is_over() -> None:
    world = World()
    network = Network(world)
    clock = SkewedClock(world, 0.1)
    here = world.process(network, clock=SkewedClock(world))
    there = world.process(network, clock=clock)
    told = []
    with here.bus.events() as events:
        for ahead in (0.1, 0.11, 0.2, 0.0, 0.0):
            clock.ahead = ahead
            world.run(5.0)
            told.append([event.over for event in iter(events.queue.get, None) if isinstance(event, ClockOffset)])
    assert told == [[False], [], [False], [True], []]
    assert clock_of(there, here).offset == pytest.approx(0.0, abs=0.003)


def test_an_offset_that_grows_while_nobody_sends_is_told() -> None:
    world = World()
    network = Network(world)
    here = world.process(network, clock=SkewedClock(world))
    world.process(network, clock=SkewedClock(world, drift=500e-6))
    with here.bus.events() as events:
        world.run(60.0)
        assert [event.over for event in iter(events.queue.get, None) if isinstance(event, ClockOffset)] == [False]
    # Signs are rare at rest, but a link that joins is answered soon.
    late = world.process(network, clock=SkewedClock(world))
    world.run(2.0)
    assert clock_of(here, late).offset == pytest.approx(0.0, abs=0.003)


def test_a_bus_with_a_simulated_clock_is_told_as_one_and_not_measured() -> None:
    world = World()
    network = Network(world)
    here, there = world.process(network, clock=SkewedClock(world), correct_clocks=True), world.process(network)
    go(world, 5.0, 1.0, (there, "cart", SkewedClock(world, 77.0)))
    assert str(clock_of(here, there)).endswith("has a simulated clock")
    assert here.frames["cart"].stamp == there.frames["cart"].stamp


def test_corrected_samples_of_near_and_far_buses_are_stamped_as_if_there_were_one_clock() -> None:
    world = World()
    first, second = Network(world), Network(world)
    first.delay = lambda *_: 0.0004
    far, middle = SkewedClock(world, 3600.0, 100e-6), SkewedClock(world, -0.3)
    here = world.process(first, clock=SkewedClock(world), correct_clocks=True)
    bridge = world.process(first, second, clock=middle, correct_clocks=True)
    slow = world.process(first, clock=SkewedClock(world), correct_clocks=True, robots={"*": 5.0})
    there = world.process(second, clock=far)
    second.delay = first.delay
    sends = (bridge, "near", middle), (there, "far", far)
    go(world, 5.0, 0.1, *sends)
    with Buffer(here.bus) as buffer:
        go(world, 10.0, 0.1, *sends)
        for frame in ("near", "far"):
            for back in (1.0, 1.005):
                at = world.now - back
                found = buffer.lookup_nowait("map", frame, round(at * SECOND)).transform.translation[0]
                assert found == pytest.approx(at, abs=0.001)
            newest = slow.frames[frame]
            assert newest.transform.translation[0] == pytest.approx(newest.stamp / SECOND, abs=0.001)
    # The bridge has corrected its own copy, and passed on what it got.
    assert bridge.frames["far"].stamp == pytest.approx((world.now - 0.3 - 0.1) * SECOND, abs=2_000_000)


def test_a_joiner_is_told_the_newest_samples_and_the_past_by_another_bus_and_corrects_them_once() -> None:
    world = World()
    network, far = Network(world), Network(world)
    network.delay = far.delay = lambda *_: 0.0004
    clock = SkewedClock(world, 7.0)
    there = world.process(far, clock=clock)
    keeper = world.process(network, far, clock=SkewedClock(world, -0.5), correct_clocks=True)
    with Buffer(keeper.bus):
        go(world, 5.0, 0.1, (there, "cart", clock))
        world.kill(there)
        world.run(1.0)
        last = world.now - 1.1
        for history in (None, 3.0):
            late = world.process(network, clock=SkewedClock(world), correct_clocks=True, history=history)
            world.run(3.0)
            assert late.frames["cart"].stamp == pytest.approx(last * SECOND, abs=2_000_000)
            corrected = [sample for sample in late.seen if abs(sample.stamp / SECOND - last) < 4.0]
            assert len(corrected) == (31 if history else 1)
            for sample in corrected:
                assert sample.stamp / SECOND == pytest.approx(sample.transform.translation[0], abs=0.002)
            world.kill(late)


@pytest.mark.parametrize("others_move", [False, True])
def test_frames_of_one_batch_that_rest_are_all_corrected_and_stay(others_move: bool) -> None:
    world = World()
    network = Network(world)
    network.delay = lambda *_: 0.0004
    clock = SkewedClock(world, 7.0)
    there = world.process(network, clock=clock)
    said = [moving("map", name, clock.now()) for name in ("arm", "hand", "tool")]
    there.say(static("map", "camera"), *said)
    began = world.now
    here = world.process(network, clock=SkewedClock(world), correct_clocks=True)
    for _ in range(50):
        if others_move:
            publish(there, "cart", clock)
        world.run(0.1)
    for sample in said:
        assert here.frames[sample.child].stamp == pytest.approx(began * SECOND, abs=2_000_000)
    # Others are told the stamps that the sender gave.
    world.kill(there)
    late = world.process(network, clock=SkewedClock(world))
    world.run(3.0)
    assert {sample.child: sample.stamp for sample in said} == {s.child: late.frames[s.child].stamp for s in said}


def test_frames_that_came_by_a_bridge_before_any_clock_was_known_are_corrected_when_it_is_told() -> None:
    world = World()
    first, second = Network(world), Network(world)
    first.delay = second.delay = lambda *_: 0.0004
    clock = SkewedClock(world, 7.0)
    here = world.process(first, clock=SkewedClock(world), correct_clocks=True)
    world.process(first, second, clock=SkewedClock(world))
    there = world.process(second, clock=clock)
    with Buffer(here.bus) as buffer:
        world.run(0.01)
        publish(there, "cart", clock)
        publish(there, "arm", clock)
        world.run(5.0)
        publish(there, "cart", clock)
        world.run(1.0)
        found = {edge.child: (edge.oldest, edge.newest) for edge in buffer.tree.edges()}
    for frame, spans in (("cart", (6.0, 1.0)), ("arm", (6.0, 6.0))):
        assert found[frame] == pytest.approx([(world.now - seconds) * SECOND for seconds in spans], abs=2_000_000)


@pytest.mark.parametrize("step", [1.0, -1.0, 0.03])
@pytest.mark.parametrize("corrects", [False, True])
def test_a_clock_that_is_set_is_noticed_at_once_and_nothing_is_interpolated_across(step: float, corrects: bool) -> None:
    world = World()
    network = Network(world)
    network.delay = lambda *_: 0.0004
    clock, other = SkewedClock(world), SkewedClock(world)
    here = world.process(network, clock=SkewedClock(world), correct_clocks=corrects)
    there, third = world.process(network, clock=clock), world.process(network, clock=other)
    sends = (there, "cart", clock), (third, "tool", other)
    with Buffer(here.bus) as buffer, here.bus.events() as events:
        go(world, 5.0, 0.1, *sends)
        before = clock.now()
        clock.ahead += step
        publish(there, "cart", clock)
        world.run(0.001)
        stepped = [event for event in iter(events.queue.get, None) if isinstance(event, PeerClockStepped)]
        assert [(event.peer, event.frames) for event in stepped] == [(there.wire.id, ("cart",))]
        assert stepped[0].step == pytest.approx(step, abs=0.001)
        go(world, 1.0, 0.01, *sends)
        spans = {edge.child: (edge.oldest or 0, edge.newest or 0) for edge in buffer.tree.edges()}
        # The other bus keeps its history.
        assert spans["tool"][0] < before - 4 * SECOND
        ahead = 0.0 if corrects else clock.offset
        oldest, newest = spans["cart"]
        assert newest - oldest == pytest.approx(1.0 * SECOND, abs=0.02 * SECOND)
        for at in range(oldest, newest, 3_000_000):
            x = buffer.lookup_nowait("map", "cart", at).transform.translation[0]
            assert x == pytest.approx(at / SECOND - ahead, abs=0.001)


@pytest.mark.parametrize("stays", [0, 1])
def test_a_clock_beyond_two_bridges_that_is_set_is_noticed_once_also_when_one_of_them_has_gone(stays: int) -> None:
    world = World()
    first, second = Network(world), Network(world)
    clock = SkewedClock(world)
    here, there = world.process(first, clock=SkewedClock(world)), world.process(second, clock=clock)
    bridges = [world.process(first, second, clock=SkewedClock(world)) for _ in range(2)]
    for left in (None, bridges[1 - stays]):
        if left is not None:
            world.kill(left)
        go(world, 20.0, 0.1, (there, "cart", clock))
        with here.bus.events() as events:
            clock.ahead += 1.0
            go(world, 5.0, 0.1, (there, "cart", clock))
            steps = [event.step for event in iter(events.queue.get, None) if isinstance(event, PeerClockStepped)]
        assert steps == [pytest.approx(1.0, abs=0.001)]


@pytest.mark.parametrize(("corrects", "ahead"), [(False, 0.31), (True, 0.31), (False, -0.31)])
def test_explanations_and_errors_name_the_clock_that_differs(corrects: bool, ahead: float) -> None:
    world = World()
    network = Network(world)
    network.delay = lambda *_: 0.0004
    clock = SkewedClock(world, ahead)
    here = world.process(network, clock=SkewedClock(world), correct_clocks=corrects)
    there = world.process(network, clock=clock)
    with Buffer(here.bus) as buffer:
        go(world, 5.0, 0.1, (there, "cart", clock))
        clear, at = buffer.explain("map", "cart").edges[0].clock, round((world.now + 1.0) * SECOND)
        missing: list[Exception] = list(buffer.explain("map", "cart", at).errors)
        for tolerance in (0.0, 0.1):
            with pytest.raises(FutureExtrapolationError) as refused:
                buffer.lookup_nowait("map", "cart", at, tolerance=tolerance)
            missing += [refused.value, pickle.loads(pickle.dumps(refused.value))]
    stamped = f", and stamped {format_stamp(there.frames['cart'].stamp)}" if corrects else ""
    assert clear == f"its clock runs 310 ms {'ahead of' if ahead > 0 else 'behind'} this one{stamped}"
    assert [str(error).endswith(clear) for error in missing] == [True] * 5
    assert str(buffer.explain("map", "cart")).endswith(clear)
    assert here.bus.statistics().frames == 1


def test_a_small_change_is_no_step() -> None:
    world = World()
    network = Network(world)
    clock = SkewedClock(world, 0.0, 500e-6)
    here, there = world.process(network, clock=SkewedClock(world)), world.process(network, clock=clock)
    with here.bus.events() as events:
        go(world, 30.0, 0.5, (there, "cart", clock))
        clock.ahead += 0.5 * STEP / SECOND
        go(world, 30.0, 10.0, (there, "cart", clock))
        kinds = [type(event) for event in iter(events.queue.get, None)]
    assert PeerJoined in kinds
    assert PeerClockStepped not in kinds


def test_a_correction_moves_smoothly_and_stays_in_order() -> None:
    world = World(3)
    network = Network(world)
    network.delay = lambda *_: world.random.uniform(0.001, 0.002)
    clock = SkewedClock(world, 0.3, 50e-6)
    here = world.process(network, clock=SkewedClock(world), correct_clocks=True)
    there = world.process(network, clock=clock)
    go(world, 10.0, 0.1, (there, "cart", clock))
    here.seen.clear()
    go(world, 20.0, 0.01, (there, "cart", clock))
    steps = [later.stamp - earlier.stamp for earlier, later in pairwise(here.seen)]
    assert len(steps) > 1_500
    assert max(abs(step - SECOND // 100) for step in steps) < 100_000


def test_frames_that_came_from_another_world_first_are_settled_once_clocks_are_known() -> None:
    world = World()
    network, foreign = Network(world), ForeignWorld()
    here, there = (world.process(network, worlds=[foreign], clock=SkewedClock(world)) for _ in range(2))
    for stamp in range(50):
        here.bus.publish([moving("map", "base", stamp)])
        world.run(0.05)
    world.run(5.0)
    assert not any(end.rejected for process in (here, there) for end in process.ends)

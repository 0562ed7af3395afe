import asyncio

import anyio
import pytest
from support.processes import free_address, until
from support.zenoh_wires import Ear, Way, listening, met, start_router, talk, way_to

from tfbus.links.seams import Left
from tfbus.links.zenoh.zenoh_router import ZenohRouter

pytestmark = pytest.mark.anyio


@pytest.mark.every_loop
async def test_links_of_routers_that_find_each_other_late_hear_each_other(address: str, domain: str) -> None:
    other = free_address()
    async with ZenohRouter(other, connect=address), listening(domain, connect=other) as one:
        async with ZenohRouter(address), listening(domain, connect=address) as two:
            await met(one, two)
            await talk(one, two)
        await until(lambda: not one.present)


@pytest.mark.thorough
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_routers_that_connect_to_each_other_tell_each_other_all_after_each_break(
    address: str, domain: str
) -> None:
    other = free_address()
    async with way_to(other) as way, way_to(address) as back:
        with start_router(address, way.address), start_router(other, back.address):
            async with listening(domain, connect=address) as one, listening(domain, connect=other) as two:
                await hear_each_other_after_each_break(one, two, way, back)


@pytest.mark.thorough
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_links_that_listen_and_connect_to_each_other_hear_each_other_after_each_break(
    address: str, domain: str
) -> None:
    other = free_address()
    async with (
        way_to(other) as way,
        way_to(address) as back,
        listening(domain, listen=address, connect=way.address, lease=1.0) as one,
        listening(domain, listen=other, connect=back.address, lease=1.0) as two,
    ):
        await hear_each_other_after_each_break(one, two, way, back)


async def hear_each_other_after_each_break(one: Ear, two: Ear, way: Way, back: Way) -> None:
    for _ in range(3):
        await met(one, two)
        await talk(one, two)
        before = len(one.items), len(two.items)
        await way.cut(far_only=True)
        await back.cut()
        await until(
            lambda before=before: any(  # type: ignore[misc]
                Left() in [item for _, item in ear.items[start:]] for ear, start in zip((one, two), before, strict=True)
            )
        )
    await met(one, two)
    await talk(one, two)


async def test_a_router_listens_at_several_addresses(address: str, domain: str) -> None:
    other = free_address()
    async with (
        ZenohRouter([address, other]),
        listening(domain, connect=address) as one,
        listening(domain, connect=other) as two,
    ):
        await met(one, two)


async def test_an_address_in_use_is_an_os_error_and_a_router_is_entered_once(address: str) -> None:
    router = ZenohRouter(address)
    async with router:
        with pytest.raises(OSError, match="cannot open a session"):
            async with ZenohRouter(address):
                raise AssertionError("it has opened")
        with pytest.raises(RuntimeError, match="entered once"):
            await router.__aenter__()
    async with ZenohRouter(address):
        pass


@pytest.mark.thorough
@pytest.mark.every_loop
async def test_a_router_whose_opening_is_cancelled_at_any_moment_frees_its_address(address: str) -> None:
    for tenths in range(60):
        with anyio.move_on_after(tenths / 10_000):
            async with ZenohRouter(address):
                await anyio.sleep_forever()
    async with ZenohRouter(address):
        pass


@pytest.mark.thorough
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_router_whose_opening_asyncio_cancels_at_any_moment_frees_its_address(address: str) -> None:
    async def enter() -> None:
        async with ZenohRouter(address):
            await anyio.sleep_forever()

    for tenths in range(60):
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(enter(), tenths / 10_000)
        async with ZenohRouter(address):
            pass


async def test_what_makes_no_sense_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match="garbage"):
        ZenohRouter("garbage")
    with pytest.raises(ValueError, match="'no'"):
        ZenohRouter(config={"no": 1})
    with pytest.raises(ValueError, match="lease"):
        ZenohRouter(lease=0.0)

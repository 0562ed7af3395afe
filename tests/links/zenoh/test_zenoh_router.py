import anyio
import pytest
from support.processes import free_address, until
from support.zenoh_wires import listening, met, talk

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


async def test_what_makes_no_sense_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match="garbage"):
        ZenohRouter("garbage")
    with pytest.raises(ValueError, match="'no'"):
        ZenohRouter(config={"no": 1})
    with pytest.raises(ValueError, match="lease"):
        ZenohRouter(lease=0.0)

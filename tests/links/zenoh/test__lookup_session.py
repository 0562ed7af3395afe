import pytest
from support.processes import until

from tfbus.links.zenoh._lookup_session import LookupSession

pytestmark = pytest.mark.anyio


async def test_servers_and_askers_of_one_robot_are_heard_of_and_no_others(address: str, domain: str) -> None:
    noted: list[tuple[str, bool]] = []
    here = LookupSession(domain, "r1", None, address, None, None, 2.0)
    there = LookupSession(domain, "r1", None, None, address, None, 2.0)
    elsewhere = LookupSession(domain, "r2", None, None, address, None, 2.0)
    sessions = (here, there, elsewhere)
    for session in sessions:
        await session.open()
    try:
        here.follow("@asking", lambda asker, present: noted.append((asker, present)))
        elsewhere.announce_asker("other")
        there.announce_asker("me")
        await until(lambda: noted == [("me", True)])
        await there.close()
        await until(lambda: noted == [("me", True), ("me", False)])
    finally:
        for session in sessions:
            await session.close()
    assert here.key("lookup") == f"tfbus/{domain}/r1/lookup"


async def test_without_a_domain_it_is_tf_and_without_a_robot_a_tilde() -> None:
    assert LookupSession(None, None, None, None, None, None, 2.0).key("@lookup", "a") == "tfbus/tf/~/@lookup/a"

from queue import Queue

import pytest
import zenoh
from support.processes import PATIENCE, until

from tfbus.links._message import Message
from tfbus.links.zenoh._keys import Keys
from tfbus.links.zenoh._opening import directly
from tfbus.links.zenoh._publishers import Publishers
from tfbus.links.zenoh._settings import settings

LINK = "a" * 32
NAME = "b" * 32


@pytest.mark.anyio
async def test_each_message_goes_to_those_who_hear_its_key_and_none_to_filters_that_have_gone(
    address: str, domain: str
) -> None:
    keys, came = Keys(domain, LINK), Queue[zenoh.Sample]()
    with zenoh.open(settings(address, None, None, 2.0)) as hearer:
        # Threads of their own would put what two subscribers have received in another order.
        put = directly(came.put, print)
        declared = [hearer.declare_subscriber(f"tfbus/{domain}/~/{kind}/**", put) for kind in ("live", "only")]
        with zenoh.open(settings([], address, None, 2.0)) as session:
            publishers = Publishers(session, keys)
            publishers.put(Message(b"all", b"1", 1))
            publishers.put_part(NAME, Message(b"part", b"2", 1))
            publishers.put_part(NAME, Message(b"more", b"3", 1))
            publishers.put_slowly(Message(b"slow", b"4", 1))
            found = [came.get(timeout=PATIENCE) for _ in range(3)]
            assert [
                (str(one.key_expr), one.payload.to_bytes(), one.attachment and one.attachment.to_bytes())
                for one in found
            ] == [
                (f"tfbus/{domain}/~/live/{LINK}", b"all", b"1"),
                (f"tfbus/{domain}/~/only/{LINK}/{NAME}", b"part", b"2"),
                (f"tfbus/{domain}/~/only/{LINK}/{NAME}", b"more", b"3"),
            ]
            assert publishers.is_heard()
            assert not publishers.is_heard_slowly()
            declared.append(hearer.declare_subscriber(f"tfbus/{domain}/~/slow/**", put))
            await until(publishers.is_heard_slowly)
            publishers.put_slowly(Message(b"slow", b"5", 1))
            slow = came.get(timeout=PATIENCE)
            assert slow.attachment is not None
            assert (str(slow.key_expr), slow.payload.to_bytes(), slow.attachment.to_bytes()) == (
                f"tfbus/{domain}/~/slow/{LINK}",
                b"slow",
                b"5",
            )
            publishers.serve({NAME})
            assert publishers._parts.keys() == {NAME}
            publishers.serve(set())
            assert publishers._parts == {}
            for subscriber in declared:
                subscriber.undeclare()

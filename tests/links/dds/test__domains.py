from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

pytest.importorskip("cyclonedds", reason='pip install "tfbus[dds]"')

from tfbus.links.dds.dds_link import Discovery, _open, configuration, domain

HERE = configuration("localhost", (), None)


@pytest.mark.parametrize(
    ("discovery", "peers", "interfaces", "addresses"),
    [
        ("localhost", (), ["lo"], ["127.0.0.1"]),
        ("localhost", ("10.0.0.5",), ["lo"], ["127.0.0.1", "10.0.0.5"]),
        ("subnet", (), [], []),
        ("subnet", ('a"<b',), [], ['a"<b']),
    ],
)
def test_others_are_looked_for_where_discovery_and_peers_say(
    discovery: Discovery, peers: tuple[str, ...], interfaces: list[str], addresses: list[str]
) -> None:
    root = ET.fromstring(configuration(discovery, peers, None))
    assert [each.get("name") for each in root.iter("NetworkInterface")] == interfaces
    assert [each.get("address") for each in root.iter("Peer")] == addresses
    assert [each.text for each in root.iter("AllowMulticast")] == ["false"] * len(interfaces)
    assert [each.text for each in root.iter("IgnoreTypeInformation")] == ["1.15"]


def test_a_configuration_of_ones_own_is_in_place_of_that_but_for_fast_dds() -> None:
    own, _, rest = configuration("localhost", ("1.2.3.4",), "file:///a.xml").partition(",")
    assert own == "file:///a.xml"
    assert [each.tag for each in ET.fromstring(rest).iter()][2:] == ["Compatibility", "IgnoreTypeInformation"]


def test_a_domain_is_open_until_its_last_user_ends(domain_number: int) -> None:
    with domain(domain_number, HERE):
        with domain(domain_number, HERE):
            assert _open[domain_number].users == 2
        assert _open[domain_number].users == 1
        # As the traceback of an error may.
        kept = _open[domain_number]
        with (
            pytest.raises(OSError, match="another configuration"),
            domain(domain_number, configuration("subnet", (), None)),
        ):
            raise AssertionError
    assert _open == {}
    with domain(domain_number, configuration("localhost", ("127.0.0.1",), None)):
        assert _open[domain_number].users == 1
    assert kept.users == 0


def test_a_configuration_that_cannot_be_read_is_an_os_error(domain_number: int, tmp_path: Path) -> None:
    broken = tmp_path / "broken.xml"
    broken.write_text("<CycloneDDS><Domain><Nonsense/></Domain></CycloneDDS>")
    with (
        pytest.raises(OSError, match=f"cannot open the DDS domain {domain_number}"),
        domain(domain_number, f"file://{broken}"),
    ):
        raise AssertionError
    assert _open == {}

import pytest

from tfbus.recording.formats._storage import Channel, channel_of

TF = "tf2_msgs/msg/TFMessage"


@pytest.mark.parametrize(
    ("topic", "static"), [("/tf", False), ("tf", False), ("/tf_static", True), ("tf_static", True)]
)
@pytest.mark.parametrize("kind", [TF, "tf2_msgs/TFMessage", "tf/tfMessage", "tf/msg/tfMessage"])
def test_transforms_are_on_two_topics_under_the_names_of_four_types(topic: str, static: bool, kind: str) -> None:
    assert channel_of(topic, kind, {}) == Channel(static)


@pytest.mark.parametrize("topic", ["/robot1/tf", "/TF", "/tf/", "//tf", "", "/", "/tf_stat"])
def test_other_topics_are_not(topic: str) -> None:
    assert channel_of(topic, TF, {}) is None


@pytest.mark.parametrize("kind", ["", "geometry_msgs/msg/TransformStamped", "tf2_msgs/msg/tfmessage"])
def test_other_types_are_not(kind: str) -> None:
    assert channel_of("/tf", kind, {}) is None


def test_a_single_authority_goes_for_any_number_of_transforms() -> None:
    channel = Channel(False, ("slam",))
    assert [*channel.tags(1)] == [("slam", False)]
    assert [*channel.tags(3)] == [("slam", False)] * 3
    assert [*channel.tags(0)] == []


def test_several_authorities_go_for_as_many_transforms_or_for_none() -> None:
    channel = Channel(True, ("slam", "arm"))
    assert [*channel.tags(2)] == [("slam", True), ("arm", True)]
    assert [*channel.tags(3)] == [("", True)] * 3

from typing import Any

import pytest

from tfbus.recording.formats.storage import Channel
from tfbus.recording.recording import Choice, Selection, looks_like_transforms

TF = "tf2_msgs/msg/TFMessage"


def tf(topic: str, kind: str = TF, encoding: str = "cdr") -> Channel:
    return Channel(topic, kind, encoding)


@pytest.mark.parametrize("kind", [TF, "tf2_msgs/TFMessage", "tf/tfMessage", "tf/msg/tfMessage"])
@pytest.mark.parametrize(
    ("topic", "static"), [("/tf", False), ("tf", False), ("/tf_static", True), ("tf_static", True)]
)
def test_by_default_two_topics_are_read_under_the_names_of_four_types(kind: str, topic: str, static: bool) -> None:
    assert Selection().choose(tf(topic, kind)) == Choice(static, "")
    assert Selection(prefix="r/").choose(tf(topic, kind)) == Choice(static, "r/")


@pytest.mark.parametrize("topic", ["/robot1/tf", "/TF", "/tf/", "//tf", "", "/", "/tf_stat", "/my_tf"])
def test_by_default_other_topics_are_not_read(topic: str) -> None:
    assert Selection().choose(tf(topic)) is None


@pytest.mark.parametrize(
    "channel",
    [
        tf("/tf", ""),
        tf("/tf", "geometry_msgs/msg/TransformStamped"),
        tf("/tf", "tf2_msgs/msg/tfmessage"),
        tf("/tf", TF, "protobuf"),
        tf("/tf", "foxglove.FrameTransform", "cbor"),
    ],
)
def test_other_types_and_encodings_are_not_read_and_are_mentioned(channel: Channel) -> None:
    assert Selection().choose(channel) is None
    assert looks_like_transforms(channel)


@pytest.mark.parametrize("kind", ["foxglove.FrameTransforms", "foxglove_msgs/msg/FrameTransform"])
def test_foxglove_transforms_are_read_from_any_topic_that_is_no_tf_of_a_namespace(kind: str) -> None:
    encoding = "cdr" if "/" in kind else "protobuf"
    for topic in ("/tf", "/transforms", "/robot1/transforms"):
        assert Selection().choose(tf(topic, kind, encoding)) == Choice(False, "")
    assert Selection().choose(tf("/robot1/tf", kind, encoding)) is None


def test_topics_are_chosen_with_prefixes_or_without() -> None:
    for topics in ("/robot1/tf", ["robot1/tf"], {"/robot1/tf": ""}):
        assert Selection(topics).choose(tf("/robot1/tf")) == Choice(False, "")
        assert Selection(topics).choose(tf("/tf")) is None
    both = Selection({"/robot1/tf": "r1/", "/fixed_static": "f/"}, prefix="fleet/")
    assert both.choose(tf("robot1/tf")) == Choice(False, "fleet/r1/")
    assert both.choose(tf("/fixed_static")) == Choice(True, "fleet/f/")
    assert both.topics == ["robot1/tf", "fixed_static"]
    assert Selection().topics == []


def test_namespaces_give_their_prefixes() -> None:
    everything = Selection(namespaces=True, prefix="x/")
    assert everything.choose(tf("/tf")) == Choice(False, "x/")
    assert everything.choose(tf("/robot1/tf")) == Choice(False, "x/robot1/")
    assert everything.choose(tf("/a/b/tf_static")) == Choice(True, "x/a/b/")
    assert everything.choose(tf("/my_tf")) is None


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"topics": ["/tf"], "namespaces": True}, ValueError),
        ({"prefix": "/r"}, ValueError),
        ({"topics": {"/tf": "/r"}}, ValueError),
        ({"topics": [3]}, TypeError),
        ({"topics": {"/tf": 3}}, TypeError),
    ],
)
def test_wrong_choices_are_refused(arguments: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        Selection(**arguments)


def test_only_what_may_be_transforms_looks_like_them() -> None:
    assert looks_like_transforms(tf("/robot1/tf", "std_msgs/msg/String"))
    assert looks_like_transforms(tf("/x"))
    assert not looks_like_transforms(tf("/x", "std_msgs/msg/String"))

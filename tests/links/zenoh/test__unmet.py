from tfbus.links.zenoh._unmet import MOST_UNMET, PAUSES, Unmet


class Scene:
    def __init__(self) -> None:
        self.time = 50.0
        self.unmet = Unmet(lambda: self.time)

    def wait(self, seconds: float, *present: str) -> list[str]:
        self.time += seconds
        return self.unmet.take_due(present)


def test_a_connection_is_looked_after_several_times_and_then_no_more() -> None:
    scene = Scene()
    scene.unmet.connected("a")
    for pause in PAUSES:
        assert scene.wait(pause - 0.1) == []
        assert scene.wait(0.2) == ["a"]
    assert scene.wait(1_000) == []


def test_whoever_is_present_is_not_looked_after_later_either() -> None:
    scene = Scene()
    for name in ("a", "b"):
        scene.unmet.connected(name)
    assert scene.wait(0.1, "a") == []
    assert scene.wait(1_000) == ["b"]


def test_a_connection_that_is_made_again_is_looked_after_anew() -> None:
    scene = Scene()
    scene.unmet.connected("a")
    assert scene.wait(PAUSES[0]) == ["a"]
    scene.unmet.connected("a")
    assert scene.wait(PAUSES[0] - 0.1) == []
    assert scene.wait(0.1) == ["a"]


def test_so_many_connections_are_remembered() -> None:
    scene = Scene()
    for number in range(MOST_UNMET + 1):
        scene.unmet.connected(f"s{number}")
    scene.time += 1.0
    scene.unmet.connected("s0")
    assert scene.wait(PAUSES[0] - 1) == [f"s{number}" for number in range(1, MOST_UNMET)]
    assert scene.wait(1.0) == ["s0"]

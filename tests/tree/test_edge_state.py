import pytest

from tfbus import SECOND, Edge
from tfbus.tree.history import EdgeState, state_of


def moving(newest: int | None) -> Edge:
    return Edge("map", "base", False, 0 if newest is None else 1, newest, newest, "")


@pytest.mark.parametrize(
    ("edge", "now", "state"),
    [
        pytest.param(moving(5 * SECOND), 6 * SECOND, EdgeState.MOVING, id="just recent enough"),
        pytest.param(moving(5 * SECOND), 6 * SECOND + 1, EdgeState.STALE, id="one ns too old"),
        pytest.param(moving(5 * SECOND), 4 * SECOND, EdgeState.MOVING, id="ahead of the clock"),
        pytest.param(moving(None), 0, EdgeState.SILENT, id="no samples"),
        pytest.param(Edge("map", "base", True, 1, None, None, ""), 9 * SECOND, EdgeState.STATIC, id="static"),
    ],
)
def test_the_state_follows_from_kind_and_age(edge: Edge, now: int, state: EdgeState) -> None:
    assert state_of(edge, now, stale_after=1.0) is state


def test_the_age_from_which_a_frame_is_stale_can_be_chosen() -> None:
    assert state_of(moving(0), 3 * SECOND, stale_after=3.0) is EdgeState.MOVING
    assert state_of(moving(0), 3 * SECOND, stale_after=2.9) is EdgeState.STALE


def test_no_two_states_share_a_colour() -> None:
    assert len({state.value for state in EdgeState}) == 4

import anyio
import pytest

from tfbus._aio.turn_budget import TurnBudget

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]


async def gives_way(budget: TurnBudget) -> bool:
    """Whether it passes a checkpoint, where a cancelled task ends."""
    with anyio.CancelScope() as scope:
        scope.cancel()
        await budget.give_way()
    return scope.cancelled_caught


async def test_work_gives_way_once_its_time_is_spent_and_not_before() -> None:
    now = 0.0
    budget = TurnBudget(2.0, lambda: now)
    now = 1.5
    assert not budget.spent
    assert not await gives_way(budget)
    now = 2.0
    assert budget.spent
    assert await gives_way(budget)
    await budget.give_way()
    now = 3.5
    assert not await gives_way(budget)
    budget.begin()
    now = 5.0
    assert not budget.spent
    now = 5.5
    assert budget.spent

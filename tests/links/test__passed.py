import pytest
from support.samples import moving, static
from support.wires import size_of

from tfbus import TransformStamped
from tfbus.links._passed import GONE_CHILDREN, PER_CHILD, PassedSamples


def passed(*samples: TransformStamped) -> PassedSamples:
    memory = PassedSamples()
    for sample in samples:
        memory.add(sample)
    return memory


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        (moving("map", "a", 5), moving("map", "a", 5), True),
        (moving("map", "a", 5, 1.0, "x"), moving("map", "a", 5, 2.0, "y"), True),
        (moving("map", "a", 5), moving("map", "a", 6), False),
        (moving("map", "a", 5), moving("odom", "a", 5), False),
        (moving("map", "a", 5), moving("map", "b", 5), False),
        (moving("map", "a", 5), static("map", "a", stamp=5), False),
        (static("map", "a", stamp=5), moving("map", "a", 5), False),
        (static("map", "a", 1.0, authority="x"), static("map", "a", 1.0, authority="y"), True),
        (static("map", "a", 1.0), static("map", "a", 2.0), False),
        (static("map", "a", 1.0), static("map", "a", 1.0, stamp=1), False),
    ],
)
def test_a_sample_is_known_by_child_parent_stamp_and_kind_and_a_static_one_by_its_value(
    first: TransformStamped, second: TransformStamped, same: bool
) -> None:
    assert (second in passed(first)) is same


def test_so_many_samples_of_each_child_are_remembered_and_what_passes_again_is_new() -> None:
    samples = [moving("map", "a", stamp) for stamp in range(PER_CHILD + 1)]
    memory = passed(moving("map", "b", 0), *samples[:PER_CHILD])
    assert PER_CHILD == 256
    assert all(sample in memory for sample in samples[:PER_CHILD])
    memory.add(samples[0])
    memory.add(samples[PER_CHILD])
    assert [sample in memory for sample in (samples[0], samples[1], samples[2])] == [True, False, True]
    assert moving("map", "b", 0) in memory


def test_children_that_left_are_remembered_up_to_a_bound_and_one_that_came_back_as_before() -> None:
    memory = passed(moving("map", "back", 1), moving("map", "stays", 1))
    memory.retire("back")
    memory.add(moving("map", "back", 2))
    memory.retire("never there")
    for number in range(3 * GONE_CHILDREN):
        memory.add(moving("map", f"{number}", 1))
        memory.retire(f"{number}")
        memory.retire(f"{number}")
    known = [f"{number}" for number in range(3 * GONE_CHILDREN) if moving("map", f"{number}", 1) in memory]
    assert known == [f"{number}" for number in range(2 * GONE_CHILDREN, 3 * GONE_CHILDREN)]
    assert moving("map", "back", 1) in memory
    assert moving("map", "stays", 1) in memory
    assert size_of(memory) == 2 * GONE_CHILDREN + 2


def test_a_child_that_leaves_once_more_is_the_last_that_left() -> None:
    memory = PassedSamples(gone_children=2)
    samples = {name: moving("map", name, 1) for name in "abc"}
    for sample in samples.values():
        memory.add(sample)
    for name in "abac":
        memory.retire(name)
    assert [sample in memory for sample in samples.values()] == [True, False, True]


def test_after_a_jump_back_only_static_samples_are_known() -> None:
    memory = passed(moving("map", "a", 1), static("map", "a"), moving("map", "b", 1))
    memory.retire("b")
    memory.forget_moving()
    assert [sample in memory for sample in (moving("map", "a", 1), static("map", "a"), moving("map", "b", 1))] == [
        False,
        True,
        False,
    ]
    assert size_of(memory) == 1


def test_nothing_of_a_forgotten_child_is_known() -> None:
    memory = passed(moving("map", "a", 1), moving("map", "b", 1))
    memory.retire("a")
    memory.forget("a")
    memory.forget("never there")
    assert size_of(memory) == 1
    assert moving("map", "b", 1) in memory

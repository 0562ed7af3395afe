"""Methods that ask the kernel first are the methods in Python in every other respect."""

import inspect
import pickle
from functools import partial
from typing import Any

import pytest
from support.samples import moving, tree_of

import tfbus
from tfbus import LATEST, Buffer, Bus, TransformArray, TransformTree
from tfbus.which_kernel import plain_first

METHODS: list[Any] = [TransformTree.lookup, TransformTree.lookup_many, Buffer.lookup_nowait]


class Asker:
    """Has a kernel's paths, and methods that tell how they were called."""

    def __init__(self, paths: Any) -> None:
        self._paths = paths

    @plain_first
    def one(self, *args: Any, fixed: Any = None, **options: Any) -> Any:
        return args, options if fixed is None else {"fixed": fixed, **options}

    @partial(plain_first, many=TransformArray)
    def many(self, *args: Any, **options: Any) -> Any:
        return args, options


def asker() -> Asker:
    tree = tree_of(moving("map", "cart", 1, 1.0), moving("map", "cart", 3, 3.0))
    tree.lookup("map", "cart", 1)
    return Asker(tree._paths)


@pytest.mark.skipif(tfbus.kernel == "python", reason="the Python kernel needs a whole signature")
def test_the_kernel_answers_a_plain_question_and_the_method_any_other() -> None:
    ask = asker()
    assert [ask.one("map", "cart", at).stamp for at in (2, LATEST)] == [2, 3]
    assert [ask.one("map", "cart").stamp, ask.one("map", "cart", at=2).stamp] == [3, 2]
    assert [ask.one("map", "cart", 2, fixed=None).stamp, ask.one("map", "cart", at=2, fixed=None).stamp] == [2, 2]
    found = ask.many("map", "cart", [1, 3])
    assert type(found) is TransformArray
    assert found.translations[:, 0].tolist() == [1.0, 3.0]
    assert (found.gap, found.extrapolated_by.tolist()) == (None, [0, 0])
    calls: list[tuple[tuple[object, ...], dict[str, object]]] = [
        (("map", "cart", 9), {}),
        (("map", "other", 2), {}),
        (("map", "cart", "2"), {}),
        (("map", "cart", 2, None), {}),
        (("map", "cart"), {"fixed": "map"}),
        (("map", "cart", 2), {"at": 2}),
        (("map",), {"at": 2}),
        (("map",), {"source": "cart"}),
        (("map", "cart", 2), {"other": None}),
        ((), {}),
    ]
    for args, options in calls:
        assert ask.one(*args, **options) == (args, options)
    calls = [(("map", "cart"), {}), (("map", "cart"), {"at": [1]}), (("map", "cart", []), {})]
    for args, options in calls:
        assert ask.many(*args, **options) == (args, options)


@pytest.mark.parametrize("paths", [None, 5])
def test_without_paths_the_method_always_runs(paths: object) -> None:
    ask = Asker(None if tfbus.kernel == "python" else paths)
    assert ask.one("map", "cart", 2) == (("map", "cart", 2), {})
    del ask._paths
    assert ask.many("map", "cart", [2]) == (("map", "cart", [2]), {})


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.__qualname__)
def test_it_has_the_signature_and_the_documentation_of_the_method(method: Any) -> None:
    function = inspect.unwrap(method)
    assert inspect.isfunction(function)
    assert inspect.signature(method) == inspect.signature(function)
    assert [*inspect.signature(method).parameters][:3] == ["self", "target", "source"]
    assert method.__doc__.startswith("The transform")
    names = (method.__module__, method.__name__, method.__annotations__)
    assert names == (function.__module__, function.__name__, function.__annotations__)
    assert inspect.isroutine(method)


def test_it_binds_pickles_and_is_overridden_as_a_method() -> None:
    class Counted(TransformTree):
        asked = 0

        def lookup(self, *args: Any, **options: Any) -> Any:
            self.asked += 1
            return super().lookup(*args, **options)

    tree = tree_of(moving("map", "cart", 1, 1.0))
    counted = Counted()
    counted.insert(moving("map", "cart", 1, 1.0))
    assert counted.can_transform("map", "cart", 1)
    assert counted.lookup("map", "cart") == tree.lookup("map", "cart") == TransformTree.lookup(tree, "map", "cart", 1)
    assert counted.asked == 2
    assert pickle.loads(pickle.dumps(tree.lookup))("map", "cart").stamp == 1
    assert tree.lookup.__self__ is tree  # type: ignore[attr-defined]


def test_a_buffer_with_a_prefix_answers_by_its_own_names() -> None:
    with Bus() as bus, Buffer(bus, prefix="r/") as buffer, Buffer(bus) as all_frames:
        bus.publish([moving("r/map", "r/cart", 1, 1.0), moving("map", "cart", 1, 2.0)])
        for _ in range(2):
            assert buffer.lookup_nowait("map", "cart", 1).transform.translation[0] == 1.0
            assert all_frames.lookup_nowait("map", "cart", 1).transform.translation[0] == 2.0

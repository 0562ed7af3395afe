import struct

import numpy as np
import pytest
from support.samples import moving, over, static, tree_of

import tfbus
from tfbus import PastExtrapolationError, TransformTree
from tfbus.tree.lookup_many import Query, plain_columns
from tfbus.tree.tree import forest_of

compiled = pytest.mark.skipif(tfbus.kernel != "compiled", reason="the kernel in Python gives no answers at many stamps")


def tree() -> TransformTree:
    return tree_of(*over("map", "cart", range(0, 1_001, 10)), static("cart", "lidar"), *over("map", "dog", [0, 500]))


@compiled
@pytest.mark.parametrize("count", [0, 1, 10, 1_000])
@pytest.mark.parametrize(("target", "source"), [("map", "cart"), ("dog", "lidar"), ("cart", "lidar"), ("map", "map")])
def test_the_columns_have_the_bits_of_single_lookups(target: str, source: str, count: int) -> None:
    known = tree()
    stamps = np.arange(count)[::-1] * 499 // max(count - 1, 1)
    (columns,) = plain_columns(forest_of(known), [Query(target, source, stamps)], with_nan=False) or [np.empty(0)]
    rows = [known.lookup(target, source, stamp).transform for stamp in stamps.tolist()]
    expected = b"".join(struct.pack("7d", *row.translation, *row.rotation) for row in rows)
    assert columns.T.tobytes() == expected
    found = known.lookup_many(target, source, stamps)
    assert np.vstack((found.translations.T, found.rotations.T)).T.tobytes() == expected


@compiled
def test_stamps_of_any_stride_are_read() -> None:
    stamps = np.arange(0, 400, dtype=np.int64)[::-7]
    (columns,) = plain_columns(forest_of(tree()), [Query("map", "cart", stamps)], with_nan=False) or [np.empty(0)]
    assert columns[0].tolist() == pytest.approx(stamps.tolist())


@compiled
def test_a_stamp_without_an_answer_is_nan_if_that_is_wanted() -> None:
    asked = [Query("map", "cart", np.array([-1, 5, 1_001]))]
    (columns,) = plain_columns(forest_of(tree()), asked, with_nan=True) or [np.empty(0)]
    assert np.isnan(columns).all(axis=0).tolist() == [True, False, True]
    assert plain_columns(forest_of(tree()), asked, with_nan=False) is None


def test_what_is_not_plain_is_left_to_others() -> None:
    known = tree()
    known.insert(moving("dog", "lidar", 400))
    known.insert_many([*over("map", "guest", [0, 10]), *over("cart", "guest", [20, 30])])
    stamps = np.array([5, 25])
    for target, source in (("map", "nobody"), ("guest", "map")):
        assert plain_columns(forest_of(known), [Query(target, source, stamps)], with_nan=True) is None
    rare = TransformTree(keep=None)
    rare.insert_many([moving("map", "far", 0, 0.0), moving("map", "far", 2**60, 4.0)])
    assert plain_columns(forest_of(rare), [Query("map", "far", stamps)], with_nan=True) is None
    assert rare.lookup_many("map", "far", [2**59]).translations[0, 0] == 2.0
    with pytest.raises(PastExtrapolationError) as caught:
        known.lookup_many("map", "cart", [5, -1, 7])
    assert caught.value.index == 1

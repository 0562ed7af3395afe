from threading import Lock

import pytest
from support.histories import moving_edge

from tfbus import Transform
from tfbus.tree.forest import _GENERATION, Path, PathCache, find_path


def path() -> Path:
    return find_path({"b": moving_edge("a", "b", [(0, Transform())])}, "a", "b", None)


def test_a_path_is_found_again_until_all_are_forgotten() -> None:
    cache, kept = PathCache(Lock()), path()
    cache.keep("a", "b", kept)
    assert cache.find("a", "b") is kept
    assert (cache.find("b", "a"), cache.find("a", "c"), len(cache)) == (None, None, 1)
    answer = cache.answer("a", "b", 0)
    assert answer is not None
    assert answer.transform == Transform()
    cache.clear()
    assert (cache.find("a", "b"), cache.answer("a", "b", 0), len(cache)) == (None, None, 0)


def test_paths_that_are_asked_for_are_kept_and_others_are_forgotten_in_time() -> None:
    cache, kept = PathCache(Lock()), path()
    cache.keep("a", "wanted", kept)
    for number in range(50_000):
        cache.keep("a", str(number), kept)
        if number % 1_000 == 0:
            assert len(cache) <= 20_000
            assert cache.find("a", "wanted") is kept
    assert cache.find("a", "0") is None
    assert cache.find("a", "49999") is kept
    assert [cache.holds("a", name) for name in ("0", "41000", "49999", "wanted")] == [False, True, True, True]
    assert not cache.holds("b", "wanted")


@pytest.mark.parametrize("cleared", [False, True])
def test_two_generations_are_kept_to_the_last_path_and_a_third_forgets_the_first(cleared: bool) -> None:
    cache, kept = PathCache(Lock()), path()
    if cleared:
        cache.keep("b", "a", kept)
        cache.clear()
    for number in range(2 * _GENERATION):
        cache.keep("a", str(number), kept)
    assert (len(cache), cache.holds("a", "0")) == (2 * _GENERATION, True)
    cache.keep("a", "more", kept)
    assert (len(cache), cache.holds("a", "0")) == (_GENERATION + 1, False)


def test_as_many_pairs_as_a_generation_has_stay_known_however_often_they_are_asked_for_in_turn() -> None:
    cache, kept = PathCache(Lock()), path()
    names = [str(number) for number in range(_GENERATION)]
    found = 0
    for _ in range(3):
        for name in names:
            if cache.find("a", name) is kept:
                found += 1
            else:
                cache.keep("a", name, kept)
    assert found == 2 * len(names)


class Name(str):
    __slots__ = ()


def test_names_that_are_no_plain_strings_are_not_kept() -> None:
    cache = PathCache(Lock())
    cache.keep(Name("a"), "b", path())
    cache.keep("a", Name("b"), path())
    assert len(cache) == 0

from hypothesis import given
from hypothesis import strategies as st

from tfbus.tree.known_frames import KnownFrames

FRAMES = ("a", "b", "c", "d")
Change = tuple[str, tuple[str, ...]]


def changes() -> st.SearchStrategy[list[Change]]:
    """Children with the parents that their samples now name; no parents means that no sample is left."""
    parents = st.lists(st.sampled_from(FRAMES), unique=True).map(tuple)
    return st.lists(st.tuples(st.sampled_from(FRAMES), parents))


def apply(names: KnownFrames, named: dict[str, tuple[str, ...]], change: Change) -> None:
    child, parents = change
    if parents:
        names.update(child, parents)
        named[child] = parents
    elif named.pop(child, None):
        names.remove(child)


@given(changes())
def test_a_frame_is_known_as_long_as_a_sample_names_it(history: list[Change]) -> None:
    names = KnownFrames()
    named: dict[str, tuple[str, ...]] = {}
    for change in history:
        apply(names, named, change)
        known = set(named).union(*named.values())
        assert names.sorted() == tuple(sorted(known))
        assert len(names) == len(known)
        assert {frame for frame in FRAMES if frame in names} == known


@given(changes(), changes())
def test_a_copy_is_independent(history: list[Change], more: list[Change]) -> None:
    names = KnownFrames()
    named: dict[str, tuple[str, ...]] = {}
    for change in history:
        apply(names, named, change)
    known = names.sorted()
    twin = names.copy()
    assert twin.sorted() == known
    for change in more:
        apply(twin, named, change)
    assert {frame for frame in FRAMES if frame in names} == set(known)
    assert twin.sorted() == tuple(sorted(set(named).union(*named.values())))


@given(changes(), st.dictionaries(st.sampled_from(FRAMES), st.sampled_from("abcdxy")))
def test_the_number_of_names_after_a_change_is_foretold(history: list[Change], parents: dict[str, str]) -> None:
    names = KnownFrames()
    named: dict[str, tuple[str, ...]] = {}
    for change in history:
        apply(names, named, change)
    foretold = names.count_after(parents)
    for child, parent in parents.items():
        names.update(child, (parent,))
    assert foretold == len(names) == len(names.sorted())


@given(changes())
def test_an_error_gets_each_name_once(history: list[Change]) -> None:
    names = KnownFrames()
    named: dict[str, tuple[str, ...]] = {}
    for change in history:
        apply(names, named, change)
        assert sorted(names.some()) == list(names.sorted())

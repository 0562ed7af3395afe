import pytest

from tfbus import Registration


def test_the_end_of_the_with_takes_it_back_once() -> None:
    undone: list[str] = []
    with Registration(lambda: undone.append("undone")) as registration:
        assert undone == []
    assert undone == ["undone"]
    registration.close()
    assert undone == ["undone"]


def test_close_inside_the_with_takes_it_back_at_once() -> None:
    undone: list[str] = []
    with Registration(lambda: undone.append("undone")) as registration:
        registration.close()
        assert undone == ["undone"]
    assert undone == ["undone"]


def test_an_error_in_the_body_takes_it_back_and_passes_through() -> None:
    undone: list[str] = []
    with pytest.raises(KeyError), Registration(lambda: undone.append("undone")):
        raise KeyError
    assert undone == ["undone"]


def test_closing_from_within_the_undoing_does_not_undo_twice() -> None:
    undone: list[str] = []

    def undo() -> None:
        undone.append("undone")
        registration.close()

    registration = Registration(undo)
    registration.close()
    assert undone == ["undone"]


def test_an_undoing_that_fails_is_not_tried_again() -> None:
    def undo() -> None:
        raise KeyError

    registration = Registration(undo)
    with pytest.raises(KeyError):
        registration.close()
    registration.close()

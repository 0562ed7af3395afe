import pytest

from tfbus import Registration


def test_the_end_of_the_with_undoes_it_once() -> None:
    undone: list[str] = []
    with Registration(lambda: undone.append("undone")) as registration:
        assert undone == []
    assert undone == ["undone"]
    registration.close()
    assert undone == ["undone"]


def test_close_inside_the_with_undoes_it_at_once() -> None:
    undone: list[str] = []
    with Registration(lambda: undone.append("undone")) as registration:
        registration.close()
        assert undone == ["undone"]
    assert undone == ["undone"]


def test_an_error_in_the_body_undoes_it_and_is_raised() -> None:
    undone: list[str] = []
    with pytest.raises(KeyError), Registration(lambda: undone.append("undone")):
        raise KeyError
    assert undone == ["undone"]


def test_closing_during_the_undo_does_not_undo_twice() -> None:
    undone: list[str] = []

    def undo() -> None:
        undone.append("undone")
        registration.close()

    registration = Registration(undo)
    registration.close()
    assert undone == ["undone"]


def test_a_failed_undo_is_not_repeated() -> None:
    def undo() -> None:
        raise KeyError

    registration = Registration(undo)
    with pytest.raises(KeyError):
        registration.close()
    registration.close()

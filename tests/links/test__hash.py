import sys
from importlib import reload

import pytest

from tfbus.links import _hash


def test_a_hash_is_that_of_the_standard(monkeypatch: pytest.MonkeyPatch) -> None:
    # RFC 7693, appendix A.
    known = "ba80a53f981c4d0d6a2797b69f12f6e94c212f14685ac4b74b12bb6fdbffa2d17d87c5392aab792dc252d5de4533cc95"
    assert _hash.hash_bytes(b"abc", 64).hex().startswith(known)
    assert len(_hash.hash_bytes(b"abc", 8)) == 8
    short = _hash.hash_bytes(b"abc", 8)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "_blake2", None)
        assert reload(_hash).hash_bytes(b"abc", 8) == short
    reload(_hash)


@pytest.mark.parametrize("size", [0, 65])
def test_a_size_that_no_hash_has_is_refused(size: int) -> None:
    with pytest.raises(ValueError):
        _hash.hash_bytes(b"", size)

import re

from tfbus.recording import open_recording
from tfbus.recording.formats import storage
from tfbus.recording.formats.storage import MIB, max_unpacked


def test_a_small_file_unfolds_to_64_mib_and_a_large_one_to_100_times_its_size() -> None:
    assert max_unpacked(1) == max_unpacked(64 * MIB // 100) == 64 * MIB
    assert max_unpacked(MIB) == 100 * MIB


def test_the_bounds_are_those_that_open_recording_tells() -> None:
    text = " ".join((open_recording.__doc__ or "").partition("Notes")[2].split())
    names = (
        "MAX_MESSAGE",
        "MAX_OTHER_MESSAGE",
        "MAX_METADATA",
        "MIN_UNPACKED",
        "MAX_INDEX",
        "MAX_DESCRIBED",
        "MAX_OVERLAPPING",
    )
    assert [int(number) * 2**20 for number in re.findall(r"(\d+) MiB", text)] == [
        getattr(storage, name) for name in names
    ]
    assert storage.MAX_CHUNK == storage.MAX_OTHER_MESSAGE
    assert "a million messages" in text
    assert storage.MAX_CHUNK_MESSAGES == 1_000_000
    assert f"at most {storage.MAX_FACTOR} times" in text

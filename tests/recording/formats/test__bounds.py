from tfbus.recording.formats._bounds import MIB, max_unpacked


def test_a_small_file_unfolds_to_64_mib_and_a_large_one_to_100_times_its_size() -> None:
    assert max_unpacked(1) == max_unpacked(64 * MIB // 100) == 64 * MIB
    assert max_unpacked(MIB) == 100 * MIB

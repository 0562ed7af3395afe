import struct
from pathlib import Path

from support.recorded import Line, write_mcap
from support.samples import moving

from tfbus import SECOND
from tfbus.recording import examine, open_recording
from tfbus.tf_message import encode


def test_a_recording_is_examined_as_it_arrived_with_the_norms_as_they_were_sent(tmp_path: Path) -> None:
    uneven = bytearray(encode([moving("odom", "base", 3 * SECOND)]))
    uneven[-8:] = struct.pack("<d", 1.005)
    lines: list[Line] = [
        *((k * SECOND, "/tf", [moving("odom", "base", k * SECOND)]) for k in range(3)),
        (3 * SECOND, "/tf", bytes(uneven)),
        (4 * SECOND, "/tf", [moving("odom", "base", 2 * SECOND)]),
        (5 * SECOND, "/tf", b"nonsense"),
    ]
    blocks: list[int] = []
    with open_recording(write_mcap(tmp_path / "run.mcap", lines)) as recording:
        found = [
            (each.kind, each.frame, each.count, each.first, each.worst)
            for each in examine(recording, progress=blocks.append)
        ]
        late = [each.kind for each in examine(recording, since=4 * SECOND, until=4 * SECOND)]
    assert found[0][:3] == ("refused", None, 1)
    assert [each[:4] for each in found[1:3]] == [
        ("stamps go back", "base", 1, 2 * SECOND),
        ("duplicate stamps", "base", 1, 2 * SECOND),
    ]
    kind, _, count, first, worst = found[3]
    assert (kind, count, first) == ("rotation", 1, 3 * SECOND)
    assert worst is not None
    assert abs(worst - 0.005) < 1e-12
    assert (sum(blocks), late) == (6, [])

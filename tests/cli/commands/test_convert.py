from pathlib import Path

import pytest
from support.commands import Command, check_wrong_call
from support.recorded import batches_in, write_mcap
from support.samples import moving, static

LINES = [
    (0, "/tf_static", [static("base", "laser", 1.5)]),
    *((k * 10**9, "/tf", [moving("odom", "base", k)]) for k in range(1, 10)),
]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "run.mcap", LINES)


def test_a_part_is_renamed_and_its_statics_go_to_a_file(source: Path, tmp_path: Path, tfbus: Command) -> None:
    out, statics = tmp_path / "out.bag", tmp_path / "statics.yaml"
    options = ("--from", "3", "--to", "5", "--rename", "base=body", "--prefix", "r/", "--static-to-yaml", statics)
    done = tfbus("convert", source, out, "--drop-static", *options)
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == f"3 messages with 3 transforms in {out}\n"
    assert [(received, [(each.parent, each.child) for each in batch]) for received, batch in batches_in(out)] == [
        (k * 10**9, [("r/odom", "body")]) for k in (3, 4, 5)
    ]
    assert statics.read_text() == (
        '- parent: "body"\n  child: "r/laser"\n  translation: [1.5, 0.0, 0.0]\n  rotation: [0.0, 0.0, 0.0, 1.0]\n'
    )


def test_inputs_are_merged_and_frames_and_topics_are_chosen(source: Path, tmp_path: Path, tfbus: Command) -> None:
    other = write_mcap(tmp_path / "other.mcap", [(2_500_000_000, "/tf", [moving("map", "odom", 2)])])
    out = tmp_path / "out.db3"
    assert tfbus("convert", source, other, out, "--topics", "/tf", "--frames", "odom").returncode == 0
    assert [batch[0].child for _, batch in batches_in(out)] == ["odom"]
    check_wrong_call(tfbus("convert", source, other, out), "give --overwrite")
    assert tfbus("convert", source, other, out, "--overwrite").returncode == 0
    assert [received for received, _ in batches_in(out)][:5] == [0, 10**9, 2 * 10**9, 2_500_000_000, 3 * 10**9]


def test_without_statics_the_file_is_an_empty_list(tmp_path: Path, tfbus: Command) -> None:
    path, statics = write_mcap(tmp_path / "run.mcap", LINES[1:]), tmp_path / "statics.yaml"
    tfbus("convert", path, tmp_path / "out.mcap", "--static-to-yaml", statics)
    assert statics.read_text() == "[]\n"


def test_what_is_left_out_is_told_with_its_details(tmp_path: Path, tfbus: Command) -> None:
    path = write_mcap(tmp_path / "run.mcap", [(1, "/a", b"{}"), (2, "/a", b"{}")], schema="my.Thing", encoding="json")
    done = tfbus("convert", path, tmp_path / "run.bag")
    lines = done.stderr.splitlines()
    assert lines[:2] == [f"0 messages with 0 transforms in {tmp_path / 'run.bag'}", "tfbus: left out: 2 x format"]
    assert "cannot hold the encoding 'json'" in lines[2]

from pathlib import Path

import pytest

pytest.importorskip("matplotlib", reason="plots need matplotlib")

from support.commands import Command, check_wrong_call
from support.recorded import write_mcap
from support.samples import moving, static

SECOND = 1_000_000_000


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A base that moves at 1 m/s for 3 s, and a laser on it."""
    lines = [
        (0, "/tf_static", [static("base", "laser", 100.0)]),
        *((k, "/tf", [moving("map", "base", k * SECOND // 10, k / 10)]) for k in range(31)),
    ]
    return write_mcap(tmp_path / "run.mcap", lines)


@pytest.mark.parametrize(
    ("kind", "begin"), [("png", b"\x89PNG"), pytest.param("PDF", b"%PDF", marks=pytest.mark.thorough)]
)
def test_the_name_of_the_output_decides_its_kind(
    recording: Path, tmp_path: Path, tfbus: Command, kind: str, begin: bytes
) -> None:
    output = tmp_path / f"picture.{kind}"
    done = tfbus("plot", recording, "map", "base", "laser", "-o", output)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", f"wrote {output}\n")
    assert output.read_bytes().startswith(begin)


def texts_of(svg: Path) -> str:
    """The file, in which matplotlib writes each text as a comment beside its outlines."""
    return svg.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "texts"),
    [
        (("map", "base"), ["Poses in map", "x [m]", "yaw [deg]", "base"]),
        (("map", "base", "--path"), ["x in map [m]", "base"]),
        (("map", "base", "--3d"), ["z in map [m]"]),
        pytest.param(("--gaps", "base"), ["period [ms]", "base"], marks=pytest.mark.thorough),
    ],
)
def test_every_picture_is_drawn(
    recording: Path, tmp_path: Path, tfbus: Command, options: tuple[str, ...], texts: list[str]
) -> None:
    output = tmp_path / "picture.svg"
    done = tfbus("plot", recording, *options, "-o", output)
    assert (done.returncode, done.stderr) == (0, f"wrote {output}\n")
    assert [text for text in texts if f"<!-- {text} -->" not in texts_of(output)] == []
    assert ("<!-- laser -->" in texts_of(output)) is ("laser" in texts)


@pytest.mark.parametrize("name", ["run.mcap", "other.mcap"])
def test_recordings_are_told_apart_by_their_names_or_else_by_their_folders_too(
    recording: Path, tmp_path: Path, tfbus: Command, name: str
) -> None:
    (tmp_path / "second").mkdir()
    other = write_mcap(tmp_path / "second" / name, [(0, "/tf", [moving("map", "base", 5), moving("map", "base", 9)])])
    done = tfbus("plot", recording, "map", "base", "--compare", other, "--text")
    lines = done.stdout.splitlines()
    names = [f"{tmp_path.name}/run", "second/run"] if name == recording.name else ["run", "other"]
    assert [line for line in lines if line in names] == names
    assert lines[lines.index(names[1]) + 1].startswith("base in map, 0.000 s to 0.000 s")


def test_text_prints_the_curves(recording: Path, tfbus: Command) -> None:
    done = tfbus("plot", recording, "map", "base", "--text")
    assert done.returncode == 0
    assert done.stdout.startswith("base in map, 0.000 s to 3.000 s\n    x  \u2581")
    assert "0.000 to 3.000 m" in done.stdout


def test_without_a_display_the_error_names_the_ways_out(
    recording: Path, tfbus: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.delenv("DISPLAY", raising=False)
    check_wrong_call(tfbus("plot", recording, "map", "base"), "there is no display: write a picture with -o")


@pytest.mark.parametrize("options", [("map", "bass", "-o", "a.png"), ("--gaps", "bass", "-o", "a.png")])
def test_an_unknown_frame_is_a_failed_lookup(recording: Path, tfbus: Command, options: tuple[str, ...]) -> None:
    done = tfbus("plot", recording, *options)
    assert (done.returncode, done.stdout) == (1, "")
    assert "'bass' is not known, did you mean 'base'?" in done.stderr


def test_gaps_tell_what_is_lost_of_the_recording(recording: Path, tmp_path: Path, tfbus: Command) -> None:
    recording.write_bytes(recording.read_bytes()[:-20])
    output = tmp_path / "a.svg"
    done = tfbus("plot", recording, "--gaps", "-o", output)
    assert done.returncode == 0
    texts = ["period [ms]", "delay [ms]", "base", "laser"]
    assert [text for text in texts if f"<!-- {text} -->" not in texts_of(output)] == []
    assert "left out of " in done.stderr
    assert "its index is missing" in done.stderr


def test_a_recording_without_transforms_has_no_gaps(tmp_path: Path, tfbus: Command) -> None:
    empty = write_mcap(tmp_path / "empty.mcap", [(0, "/tf", [])])
    check_wrong_call(tfbus("plot", empty, "--gaps", "-o", tmp_path / "a.png"), "there are no transforms")

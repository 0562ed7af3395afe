"""A call that no command can use is one line on standard error, and status 2."""

import shlex
import shutil
from pathlib import Path

import pytest
from support.commands import Command, check_wrong_call
from support.recorded import write_mcap
from support.samples import moving

from tfbus import SECOND

START = 1_700_000_000 * SECOND
ARM = Path(__file__).parents[2] / "demos" / "robot_arm.urdf"
NEEDS = {
    "plot": "matplotlib",
    "view": "trimesh",
    "foxglove": "foxglove",
    "rosbridge": "wsproto",
    "robot": "urdf_parser_py",
    "router": "zenoh",
}
"""The packages of the extras that commands need, by the names under which they are imported."""


@pytest.mark.parametrize(
    ("words", "why"),
    [
        # All commands
        ("no-such-command", "no-such-command"),
        ("tree --no-such-option", "--no-such-option"),
        ("tree surplus", "surplus"),
        ("info", "FILE"),
        ("listen --backend curio", "--backend"),
        ("listen --log-level loud", "--log-level"),
        ("broadcast --listen rubbish", "an address is like tcp/192.168.1.5:7447, not 'rubbish'"),
        *(
            (f"router --listen {address}", "an address is like tcp/")
            for address in (
                "7447",
                "foo/127.0.0.1:7447",
                "tcp/:7447",
                "tcp/::1:7447",
                "tcp/a:x",
                "tcp/a:65536",
                "tcp//a:1",
            )
        ),
        ("static map odom --domain 'a b'", "a domain is made of letters"),
        # The commands of tf2
        ("view_frames", "tf2's view_frames is `tfbus tree`"),
        ("tf2_echo map base", "`tfbus echo TARGET SOURCE`"),
        ("static_transform_publisher 0 0 0 0 0 0 a b", "`tfbus static PARENT CHILD"),
        ("echo map base_link 10", "tf2_echo's rate is an option: type tfbus echo map base_link --rate 10"),
        ("echo map base_link arm", "expected TARGET and SOURCE, not 'arm' as well"),
        # Frames, and places to join
        ("echo map", "SOURCE"),
        ("monitor map", "'map' has no SOURCE"),
        ("query run.mcap map base map", "has no SOURCE"),
        ("echo map /base_link", "write 'base_link'"),
        ("echo '' base_link", "must not be empty"),
        ("echo map base_link --remote --robots r1 --robots r2", "one robot"),
        ("echo map base_link --remote --robots a/b", "robot"),
        ("echo map base_link --remote --correct-clocks", "with --remote, the other program answers"),
        ("echo map base_link --ros dds --correct-clocks", "ROS tells no clocks, give --ros-offset"),
        ("echo map base --ros ws://127.0.0.1:1", "cannot join ROS at ws://127.0.0.1:1: "),
        ("bridge ws://127.0.0.1:1 tf", "cannot join ROS at ws://127.0.0.1:1: "),
        *((f"bridge {ends}", "two places") for ends in ("dds dds", "tf domain:tf", "dds dds --connect tcp/a:1")),
        (
            "bridge tf domain:yard --odometry /odom",
            "--odometry is for ROS, and neither 'tf' nor 'domain:yard' is there",
        ),
        ("static map", "CHILD is missing: tfbus static map CHILD, or a file that ends in"),
        ("view --points /scan", "--points shows a topic of a recording: name the file"),
        ("foxglove --port -1", "--port"),
        ("foxglove --port 65536", "--port"),
        ("foxglove --origin robot.example", "robot.example"),
        ("rosbridge --origin robot.example", "robot.example"),
        ("view --origin robot.example", "robot.example"),
        ("view run.mcap --port 65536", "--port"),
        ("view run.mcap --fixed /map", "/map"),
        ("view run.mcap --trail ''", "empty"),
        ("view run.mcap --urdf nowhere.urdf", "cannot use nowhere.urdf: No such file"),
        ("view run.mcap --urdf run.mcap", "not well-formed"),
        # Recordings
        *((f"{words}", "recording 'no.mcap': there is no such file") for words in ("info no.mcap", "play no.mcap")),
        *((f"{words}", "there is no such file") for words in ("query no.mcap a b", "check no.mcap", "view no.mcap")),
        ("info arm.urdf", "recording 'arm.urdf': it is not a recording of ROS 1 (.bag) or ROS 2 (.mcap, .db3)"),
        ("check yard --from 1", "there is no file 'yard'"),
        ("check --from 1", "--from and --to are for recordings, and none is given"),
        ("check yard --ros dds", "--ros joins ROS in place of a domain: leave 'yard' out"),
        ("tree run.mcap --watch", "--watch and --duration are for a domain"),
        ("tree --tf /robot1/tf", "--tf, --tf-prefix and --ros-offset are for ROS: give --ros, such as --ros dds"),
        ("play run.mcap --from=-1", "expected a time from the beginning on"),
        ("play run.mcap --from 10.1", "is 10.000 s long"),
        ("play run.mcap --from 5 --to 4.9", "--to must not be before --from"),
        ("play run.mcap --to 1970-01-01", "--to must not be before"),
        ("query run.mcap map base --csv --json", "give one of them"),
        ("query run.mcap map base --tum --parquet x", "give one of them"),
        ("query run.mcap map base map arm --tum", "ask for one pair"),
        ("query run.mcap map base --topic /a --namespaces", "give one of them"),
        ("query run.mcap map base --stamps-of /nothing", "nothing is on topic"),
        ("query run.mcap map base --at 1 --every 1", "give one of them"),
        ("query run.mcap map base --at yesterday", "or a date such as 2014-03-31T19:24:50, not 'yesterday'"),
        ("query run.mcap map base --every 0", "more than 0 s"),
        ("query run.mcap map base --every 0.000000001", "there would be 10,000,000,001 lines"),
        ("compare run.mcap run.mcap --pair base", "a pair is TARGET:SOURCE"),
        ("compare run.mcap run.mcap --pair map:base --csv --json", "give one of them"),
        ("compare run.mcap run.mcap --pair map:base --delta 0", "delta must be at least 1"),
        ("convert out.mcap", "at last the new file"),
        ("convert run.mcap out.csv", "must end in .mcap, .bag, .db3"),
        ("convert run.mcap out.mcap --rename base", "--rename is OLD=NEW"),
        ("convert run.mcap out.mcap --rename base=/x", "must not start with '/'"),
        ("convert run.mcap missing/out.mcap", "cannot write missing/out.mcap"),
        ("convert missing.bag out.mcap", "there is no such file"),
        ("plot run.mcap map -o a.png", "at least one source"),
        ("plot run.mcap map base -o a.gif", ".png, .svg or .pdf"),
        ("plot run.mcap --gaps --path", "--gaps"),
        ("plot run.mcap map base --text --path", "--text"),
        pytest.param("plot run.mcap map base -o no/a.png", "cannot write no/a.png", marks=pytest.mark.thorough),
        # Robots, and transforms that are typed
        ("robot elbw=1", "the URDF comes first: tfbus robot FILE elbw=1"),
        ("robot arm.urdf elbw=1", "'arm' has no joint 'elbw', did you mean 'elbow_flex'?"),
        ("robot arm.urdf wrist=1", "did you mean 'wrist_flex' or 'wrist_roll'?"),
        ("robot arm.urdf shoulderpan=1", "did you mean 'shoulder_pan' or 'shoulder_lift'?"),
        ("robot arm.urdf --follow", "give --ros"),
        ("robot arm.urdf shoulder=1 --follow --ros dds", "give none"),
        *((f"robot {options}", "give") for options in ("", "--follow", "--follow --tree --ros dds")),
        ("static a b --rpy 0 0 1 --quaternion 0 0 0 1", "give one of them"),
        ("static a b --quaternion 0 0 0 0", "zero quaternion"),
        ("static a b --quaternion 0 0 0 2", "its norm is 2"),
        ("static a b --xyz nan 0 0", "not finite"),
        ("static a b --xyz 1 2 x", "--xyz"),
        ("static a a", "its own parent"),
        ("static /a b", "write 'a'"),
        ("static '' b", "must not be empty"),
        ("static a \udcff", "UTF-8"),
        ("static a --xyz 1 2 3", "CHILD"),
        ("static a b c", "'c'"),
        ("static a b --rpy 0 0 1 --rpy-deg 0 0 1", "--rpy and --rpy-deg"),
        ("static a b --rpy-deg 0 nan 0", "not finite"),
        ("static calibration.yaml", "there is no such file"),
        # tf2 has x y z yaw pitch roll, or a quaternion, before the frames; ROS 1 has a period behind them.
        ("static 1 -2 3 0.1 0.2 0.3 a b", "type tfbus static a b --xyz 1 -2 3 --rpy 0.3 0.2 0.1"),
        ("static 1 2 3 0 0 0 1 a b", "type tfbus static a b --xyz 1 2 3 --quaternion 0 0 0 1"),
        ("static -1 2 3 0.1 0.2 0.3 a b 100", "type tfbus static a b --xyz -1 2 3 --rpy 0.3 0.2 0.1"),
        ("static 1 2 3 a b", "expected PARENT and CHILD"),
    ],
)
def test_a_wrong_call_is_one_line_on_standard_error_and_status_2(
    words: str, why: str, tfbus: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("wsproto" if "ws://" in words else "anyio", NEEDS.get(words.partition(" ")[0], "anyio")):
        pytest.importorskip(name)
    monkeypatch.chdir(tmp_path)
    shutil.copy(ARM, "arm.urdf")
    stamps = range(START, START + 11 * SECOND, SECOND)
    write_mcap(tmp_path / "run.mcap", [(stamp, "/tf", [moving("map", "base", stamp)]) for stamp in stamps])
    check_wrong_call(tfbus(*shlex.split(words)), why)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arm.urdf", "run.mcap"]

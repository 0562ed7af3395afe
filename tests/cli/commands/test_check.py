import json
from pathlib import Path

from support.commands import START, Command
from support.recorded import SMALL, write_mcap
from support.samples import moving

from tfbus import SECOND, Bus

LINES = [(k * SECOND, "/tf", [moving("map", "base", k * SECOND, float(k))]) for k in range(10)]


def test_nothing_wrong_is_status_0(tmp_path: Path, tfbus: Command) -> None:
    done = tfbus("check", write_mcap(tmp_path / "run.mcap", LINES))
    assert (done.returncode, done.stdout, done.stderr) == (0, "nothing is wrong\n", "")


def test_what_is_wrong_is_told_with_an_advice_and_status_1(tmp_path: Path, tfbus: Command) -> None:
    far = (10 * SECOND, "/tf", [moving("map", "base", 10 * SECOND, 1e9)])
    path = write_mcap(tmp_path / "run.mcap", [*LINES, far])
    done = tfbus("check", path)
    assert done.returncode == 1
    assert done.stdout.splitlines() == [
        "translation       'base': farther than 1e+08 m, 1 x, worst 1e+09 m at 10.000 s, first at 10.000 s",
        "                  -> no robot is there: look for an uninitialised or diverged estimate at its sender",
    ]
    (finding,) = json.loads(tfbus("check", path, "--json").stdout)
    assert (finding["kind"], finding["frame"], finding["worst"], finding["at"]) == ("translation", "base", 1e9, 10**10)
    assert "no robot is there" in finding["advice"]
    assert tfbus("check", path, "--to", "9").returncode == 0
    assert tfbus("check", path, "--max-translation", "1e10").stdout.startswith("jump ")
    assert tfbus("check", path, "--to", "9", "--max-speed", "0.5").returncode == 1


def test_a_file_without_its_end_is_examined_as_far_as_it_goes(tmp_path: Path, tfbus: Command) -> None:
    path = write_mcap(tmp_path / "run.mcap", LINES, finish=False)
    done = tfbus("check", path)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("unfinished        10 messages were read of the file; it is cut, or")


def test_a_finished_bag_that_is_cut_is_a_finding(tmp_path: Path, tfbus: Command) -> None:
    path = tmp_path / "cut.bag"
    # Its index is at its end, and its header tells where.
    path.write_bytes(SMALL.read_bytes()[:-100])
    done = tfbus("check", path, "--json")
    assert done.returncode == 1
    unfinished, *_ = json.loads(done.stdout)
    assert unfinished["kind"] == "unfinished"
    assert "it was finished once and is cut or damaged" in unfinished["detail"]


def test_a_domain_is_examined_for_some_time(tfbus: Command) -> None:
    async def robot(bus: Bus) -> None:
        await bus.clock.sleep(0.5)
        bus.publish(moving("map", "base", START + SECOND))
        bus.publish(moving("map", "base", START + SECOND // 4))
        await bus.clock.sleep(100.0)

    for words, place in (
        (("yard",), "domain 'yard'"),
        (("--domain", "yard"), "domain 'yard'"),
        (("--ros", "dds:42"), "ROS at dds:42"),
    ):
        done = tfbus.on_domain(robot, "check", *words, "--duration", "3", "--json")
        assert done.returncode == 1
        assert f"listening to {place} for 3 s" in done.stderr
        assert [finding["kind"] for finding in json.loads(done.stdout)] == ["stamps go back", "ahead"]

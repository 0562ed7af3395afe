"""The content of a URDF, and the parts that it must not contain."""

import math
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tfbus import InvalidRobotError, Joint, Mimic, Transform
from tfbus.robot import Box, Cylinder, Mesh, Sphere, Visual, read_visuals
from tfbus.robot.model import MAX_DEPTH, read_urdf

LINKS = '<link name="a"/><link name="b"/>'


def robot(*parts: str) -> str:
    return f'<?xml version="1.0"?>\n<robot name="r">{"".join(parts)}</robot>'


def joint(inside: str = "", kind: str = "fixed", name: str = "j") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="a"/><child link="b"/>{inside}</joint>'


def only_joint(inside: str = "", kind: str = "fixed") -> Joint:
    [found] = read_urdf(robot(LINKS, joint(inside, kind))).joints
    return found


def problem(source: Any) -> str:
    with pytest.raises(InvalidRobotError) as caught:
        read_urdf(source)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_names_links_and_joints_come_in_the_order_of_the_file() -> None:
    found = read_urdf(robot('<link name="b"/>', joint(name="2"), '<link name="a"/>', joint(name="1")))
    assert (found.name, found.links) == ("r", ("b", "a"))
    assert [each.name for each in found.joints] == ["2", "1"]


def test_a_namespace_of_the_whole_document_changes_nothing() -> None:
    text = robot(LINKS, joint('<origin xyz="1 2 3"/>'))
    assert read_urdf(text.replace("<robot", '<robot xmlns="http://example.org/urdf"')) == read_urdf(text)


def test_all_fields_of_a_joint_are_read() -> None:
    found = only_joint(
        '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/><axis xyz="0 0 2"/><mimic joint="k" multiplier="-2"'
        ' offset="0.5"/><limit lower="-1" upper="1e-1" effort="5" velocity="2"/><dynamics damping="1"/>'
        '<calibration rising="0.1"/><safety_controller k_velocity="1"/>',
        "revolute",
    )
    half = math.sqrt(0.5)
    assert found.origin.is_close(Transform((1.0, 2.0, 3.0), (0.0, 0.0, half, half)))
    assert (found.name, found.kind, found.parent, found.child) == ("j", "revolute", "a", "b")
    assert (found.axis, found.lower, found.upper) == ((0.0, 0.0, 1.0), -1.0, 0.1)
    assert found.mimic == Mimic("k", -2.0, 0.5)


def test_missing_fields_of_a_joint_get_the_defaults_of_the_specification() -> None:
    assert only_joint(kind="continuous") == Joint("j", "continuous", "a", "b", Transform(), (1.0, 0.0, 0.0))
    assert only_joint('<mimic joint="k"/>', "continuous").mimic == Mimic("k", 1.0, 0.0)
    assert only_joint('<mimic joint="k" multiplier="0"/>', "continuous").mimic == Mimic("k", 0.0, 0.0)
    assert only_joint('<origin rpy="0 0 0"/>').origin == Transform()
    assert only_joint('<origin xyz="1 2 3"/>').origin == Transform((1.0, 2.0, 3.0))
    limited = only_joint('<limit effort="1" velocity="1" upper="2"/>', "prismatic")
    assert (limited.lower, limited.upper) == (0.0, 2.0)


@pytest.mark.parametrize("kind", ["continuous", "planar", "floating", "fixed"])
def test_limits_are_read_only_for_kinds_that_have_limits(kind: str) -> None:
    found = only_joint('<limit effort="1" velocity="1" lower="-1" upper="1"/>', kind)
    assert (found.lower, found.upper) == (None, None)


def test_a_source_with_a_bracket_is_text_and_any_other_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = robot('<link name="küche"/>')
    path = tmp_path / "robot.urdf"
    path.write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert read_urdf(text) == read_urdf(path) == read_urdf(str(path)) == read_urdf("robot.urdf")
    assert read_urdf(text).links == ("küche",)
    odd = tmp_path / "<robot>.urdf"
    odd.write_text(text, encoding="utf-8")
    assert read_urdf(odd) == read_urdf(text)


def test_the_declared_encoding_of_a_file_is_used(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(robot('<link name="küche"/>').replace("?>", ' encoding="latin-1"?>'), encoding="latin-1")
    assert read_urdf(path).links == ("küche",)


@pytest.mark.parametrize("name", ["missing.urdf", ""])
def test_a_file_that_cannot_be_read_raises_the_oserror(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OSError, match=r"missing\.urdf|directory"):
        read_urdf(name)


PASSED_OVER = {
    "a legacy transmission": '<transmission type="t" name="t"><actuator name="m"/><joint name="j"/></transmission>',
    "gazebo": '<gazebo><plugin><link name="not one"/></plugin></gazebo><gazebo reference="a"/>',
    "an extension": '<sensor name="s"><parent link="a"/></sensor><ros2_control name="x" type="system"/>',
    "a call that xacro left": '<xacro:old_macro xmlns:xacro="http://ros.org/wiki/xacro" name="x"/>',
    "a comment": '<!-- <link name="c"/> --><?editor state="x"?>',
}


@pytest.mark.parametrize("part", PASSED_OVER.values(), ids=PASSED_OVER)
def test_elements_other_than_links_joints_and_materials_are_ignored(
    part: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert read_urdf(robot(LINKS, part, joint())) == read_urdf(robot(LINKS, joint()))
    assert capfd.readouterr() == ("", "")


KNOWN_ELSEWHERE = [
    '<collision><verbose value="x"/><geometry><box size="1 1 1"/></geometry><material name="m"/></collision>',
    '<self_collision_checking/><visual><geometry><mesh filename="m" units="cm"/></geometry></visual>',
    '<collision><geometry><capsule radius="1" length="2"/></geometry></collision>',
    '<visual><geometry><sphere radius="1"/></geometry><material name="m" x="y"/></visual>',
]


@pytest.mark.parametrize("inside", KNOWN_ELSEWHERE)
def test_unknown_parts_of_a_link_are_ignored_silently(inside: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert read_urdf(robot(f'<link name="a" type="laser">{inside}</link>')).links == ("a",)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ('<link name="a"/><link/>', "in <link> number 2: Required attribute not set in XML: name"),
        (joint(kind="ball"), 'in <joint name="j">: Invalid joint type: ball'),
        (joint(kind="unknown"), "in <joint name=\"j\">: type 'unknown' is none of fixed"),
        ('<joint type="fixed"/>', "in <joint> number 1: Required attribute not set in XML: name"),
        ('<joint name="j" type="fixed"><child link="b"/></joint>', 'in <joint name="j">: Required element not'),
        ('<joint name="j" type="fixed"><parent/></joint>', 'in <joint name="j">: <parent> has no link'),
        (joint("<axis/>"), 'in <joint name="j">: <axis> has no xyz'),
        (joint('<axis xyz="0 0 0"/>', "revolute"), 'in <joint name="j">: axis (0.0, 0.0, 0.0) has no direction'),
        (joint('<origin xyz="1 2"/>'), 'in <joint name="j">: origin[@xyz]: Invalid vector length'),
        (joint('<origin xyz="1 2 x"/>'), "in <joint name=\"j\">: origin[@xyz]: could not convert string to float: 'x'"),
        (joint('<origin xyz="1 2 nan"/>'), 'in <joint name="j">: origin: translation [1.0, 2.0, nan] is not finite'),
        (joint("<origin/><origin/>"), 'in <joint name="j">: there is more than one <origin>'),
        (joint('<limit lower="0"/>', "revolute"), 'in <joint name="j">: limit: Required attribute not set in XML: '),
        (joint("<mimic/>"), 'in <joint name="j">: mimic: Required attribute not set in XML: joint'),
        (joint('<mimic joint="k" offset="nan"/>'), 'in <joint name="j">: a limit or the mimic is NaN'),
        ('<link name="a"><visual/></link>', 'in <link name="a">: visual[1]: Required element not set in XML: geometry'),
        ('<link name="a"><inertial><mass/></inertial></link>', 'in <link name="a">: <mass> has no value'),
        ('<material name="m"/>', 'in <material name="m">: it has neither a color nor a texture'),
        ('<material><color rgba="1 1 1 1"/></material>', "in <material> number 1: Required attribute not set in XML"),
    ],
)
def test_the_error_names_the_malformed_element(parts: str, message: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert problem(robot(parts)).startswith(message)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "it is not well-formed XML: unclosed token: line 1, column 0"),
        ('<robot name="r"><x:link name="a"/></robot>', "it is not well-formed XML: unbound prefix"),
        ('<?xml version="1.0" encoding="none-such"?><robot/>', "in <robot>: Required attribute not set in XML: name"),
        ("<robot/>\ud800", "it is not well-formed XML: "),
        ("<sdf version='1.6'/>", "a URDF is a <robot>, but this is a <sdf>"),
        ("<robot/>", "in <robot>: Required attribute not set in XML: name"),
        ('<robot name="r" version="2.0"/>', 'in <robot name="r">: Invalid version; only 1.0 is supported'),
    ],
)
def test_other_documents_than_urdf_are_refused(text: str, message: str) -> None:
    assert problem(text).startswith(message)


@pytest.mark.parametrize(
    "content", [b"", b"\x89PNG\r\n", b'<?xml version="1.0" encoding="none-such"?><robot/>', b"\xff\xfe<\x00", b"a: 1\n"]
)
def test_a_file_of_another_kind_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_bytes(content)
    assert problem(path).startswith("it is not well-formed XML: ")


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ('<xacro:include filename="arm.xacro"/>', "in <xacro:include>: this is still to be expanded: run xacro"),
        ('<xacro:macro name="arm"/>', 'in <xacro:macro name="arm">: this is still to be expanded'),
        (joint('<xacro:insert_block name="o"/>'), 'in <xacro:insert_block name="o">: this is still to be expanded'),
        ('<link name="a"><xacro:inertia m="1"/></link>', "in <xacro:inertia>: this is still to be expanded"),
        (joint('<origin xyz="0 0 ${h}"/>'), "in <joint name=\"j\">: '0 0 ${h}' is still to be expanded: run xacro"),
        ('<link name="$(arg side)_arm"/>', "in <link name=\"$(arg side)_arm\">: '$(arg side)_arm' is still"),
    ],
)
@pytest.mark.parametrize("namespace", ["http://www.ros.org/wiki/xacro", "http://ros.org/wiki/xacro"])
def test_unexpanded_xacro_is_refused_by_name(parts: str, message: str, namespace: str) -> None:
    assert problem(robot(parts).replace("<robot", f'<robot xmlns:xacro="{namespace}"')).startswith(message)


LAUGHS = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
DOCTYPES = {
    "a billion laughs": f'<!DOCTYPE robot [<!ENTITY l0 "ha">{LAUGHS}]><robot name="&l9;"/>',
    "a file of the machine": '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/hostname">]><robot name="&x;"/>',
    "something from the net": '<!DOCTYPE robot SYSTEM "http://127.0.0.1:1/robot.dtd"><robot name="r"/>',
    "a parameter entity": '<!DOCTYPE robot [<!ENTITY % x SYSTEM "file:///etc/hostname">%x;]><robot name="r"/>',
    "nothing": '<!DOCTYPE robot><robot name="r"/>',
}


@pytest.mark.parametrize("text", DOCTYPES.values(), ids=DOCTYPES)
def test_a_document_type_is_refused(text: str) -> None:
    assert problem(text) == "it has a <!DOCTYPE>, which can define entities without end: URDF needs none"


@pytest.mark.thorough
def test_ten_megabytes_of_nesting_are_refused_at_the_limit() -> None:
    assert problem("<robot>" * 1_500_000) == f"its elements are nested more than {MAX_DEPTH} deep"


def test_elements_may_be_nested_as_deep_as_the_limit() -> None:
    deep = MAX_DEPTH - 1
    assert read_urdf(robot('<link name="a"/>', "<x>" * deep, "</x>" * deep)).links == ("a",)
    for before in ("", "<x/>" * MAX_DEPTH):
        assert "nested" in problem(robot(before, "<x>" * MAX_DEPTH, "</x>" * MAX_DEPTH))


def test_an_error_about_an_element_pickles() -> None:
    with pytest.raises(InvalidRobotError) as caught:
        read_urdf(robot(joint('<origin xyz="1 2 x"/>')))
    twin = pickle.loads(pickle.dumps(caught.value))
    assert (str(twin), twin.element, twin.__cause__) == (str(caught.value), '<joint name="j">', None)


@pytest.mark.thorough
def test_reading_does_not_depend_on_asserts() -> None:
    """The parser checks with ``assert``, which ``python -O`` leaves out."""
    script = (
        "import tfbus\n"
        "for part in ('<axis xyz=\"1 0\"/>', '<origin xyz=\"1 0\"/>'):\n"
        "    try: tfbus.RobotModel.from_urdf("
        f"{robot(LINKS, joint('PART', 'revolute'))!r}.replace('PART', part))\n"
        "    except tfbus.InvalidRobotError as error: print(error.element)"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-O", "-c", script], capture_output=True, text=True, check=True, env=os.environ
    )
    assert done.stdout == '<joint name="j">\n' * 2


def linked(visuals: str, materials: str = "") -> str:
    return f'<robot name="r">{materials}<link name="base">{visuals}</link></robot>'


def shaped(shape: str, rest: str = "") -> str:
    return linked(f"<visual><geometry>{shape}</geometry>{rest}</visual>")


@pytest.mark.parametrize(
    ("text", "shape"),
    [
        ('<box size="1 2 3"/>', Box((1.0, 2.0, 3.0))),
        ('<cylinder radius="0.5" length="2"/>', Cylinder(0.5, 2.0)),
        ('<sphere radius="0.5"/>', Sphere(0.5)),
        ('<mesh filename="package://p/a.stl"/>', Mesh("package://p/a.stl")),
        ('<mesh filename="a.stl" scale="1 2 0.5"/>', Mesh("a.stl", (1.0, 2.0, 0.5))),
    ],
)
def test_every_shape_is_read(text: str, shape: Box | Cylinder | Sphere | Mesh) -> None:
    assert read_visuals(shaped(text)) == [Visual("base", shape)]


def test_a_visual_has_the_origin_of_its_shape() -> None:
    [visual] = read_visuals(shaped('<sphere radius="1"/>', '<origin xyz="1 2 3" rpy="0.1 -0.2 0.3"/>'))
    assert visual.origin.is_close(Transform.from_xyz_rpy((1, 2, 3), (0.1, -0.2, 0.3)))


def test_the_colour_is_its_own_or_that_of_the_material_it_names() -> None:
    material = '<material name="{}">{}</material>'
    red, blue = '<color rgba="1 0 0 1"/>', '<color rgba="0 0 1 0.5"/>'

    def colour(inside: str, outside: str) -> tuple[float, ...] | None:
        ball = '<visual><geometry><sphere radius="1"/></geometry>'
        [visual] = read_visuals(linked(f"{ball}{inside}</visual>", outside))
        return visual.colour

    assert colour(material.format("paint", red), "") == (1.0, 0.0, 0.0, 1.0)
    assert colour('<material name="paint"/>', material.format("paint", blue)) == (0.0, 0.0, 1.0, 0.5)
    assert colour(material.format("paint", red), material.format("paint", blue)) == (1.0, 0.0, 0.0, 1.0)
    assert colour('<material name="other"/>', material.format("paint", blue)) is None
    assert colour(material.format("paint", '<color rgba="2 -1 0 1"/>'), "") == (1.0, 0.0, 0.0, 1.0)


def test_a_link_has_any_number_of_visuals_in_the_order_of_the_file() -> None:
    ball = '<visual><geometry><sphere radius="{}"/></geometry></visual>'
    text = linked(ball.format(1) + '<visual><geometry><capsule radius="9"/></geometry></visual>' + ball.format(2))
    assert [visual.shape for visual in read_visuals(text)] == [Sphere(1.0), Sphere(2.0)]
    assert read_visuals(linked("")) == []


@pytest.mark.parametrize(
    "shape", ['<sphere radius="nan"/>', '<box size="1 inf 1"/>', '<mesh filename="a" scale="nan 1 1"/>']
)
def test_a_size_or_an_origin_that_is_not_finite_names_its_link(shape: str) -> None:
    with pytest.raises(InvalidRobotError, match=r'<link name="base">.*not finite'):
        read_visuals(shaped(shape))
    with pytest.raises(InvalidRobotError, match='<link name="base">: origin'):
        read_visuals(shaped('<sphere radius="1"/>', '<origin xyz="nan 0 0"/>'))


def test_a_file_is_read_as_its_text_is(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(shaped('<sphere radius="2"/>'))
    assert read_visuals(path) == read_visuals(str(path)) == [Visual("base", Sphere(2.0))]

from pathlib import Path

import pytest

from tfbus import InvalidRobotError, Transform
from tfbus.robot import Box, Cylinder, Mesh, Sphere, Visual, read_visuals


def robot(visuals: str, materials: str = "") -> str:
    return f'<robot name="r">{materials}<link name="base">{visuals}</link></robot>'


def shaped(shape: str, rest: str = "") -> str:
    return robot(f"<visual><geometry>{shape}</geometry>{rest}</visual>")


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
    [visual] = read_visuals(shaped('<sphere radius="1"/>', '<origin xyz="1 2 3" rpy="0 0 0.5"/>'))
    assert visual.origin.is_close(Transform.from_xyz_rpy((1, 2, 3), (0, 0, 0.5)))


def test_the_colour_is_its_own_or_that_of_the_material_it_names() -> None:
    material = '<material name="{}">{}</material>'
    red, blue = '<color rgba="1 0 0 1"/>', '<color rgba="0 0 1 0.5"/>'

    def colour(inside: str, outside: str) -> tuple[float, ...] | None:
        ball = '<visual><geometry><sphere radius="1"/></geometry>'
        [visual] = read_visuals(robot(f"{ball}{inside}</visual>", outside))
        return visual.colour

    assert colour(material.format("paint", red), "") == (1.0, 0.0, 0.0, 1.0)
    assert colour('<material name="paint"/>', material.format("paint", blue)) == (0.0, 0.0, 1.0, 0.5)
    assert colour(material.format("paint", red), material.format("paint", blue)) == (1.0, 0.0, 0.0, 1.0)
    assert colour('<material name="other"/>', material.format("paint", blue)) is None
    assert colour(material.format("paint", '<color rgba="2 -1 0 1"/>'), "") == (1.0, 0.0, 0.0, 1.0)


def test_a_link_has_any_number_of_visuals_in_the_order_of_the_file() -> None:
    ball = '<visual><geometry><sphere radius="{}"/></geometry></visual>'
    text = robot(ball.format(1) + '<visual><geometry><capsule radius="9"/></geometry></visual>' + ball.format(2))
    assert [visual.shape for visual in read_visuals(text)] == [Sphere(1.0), Sphere(2.0)]
    assert read_visuals(robot("")) == []


@pytest.mark.parametrize(
    "shape", ['<sphere radius="nan"/>', '<box size="1 inf 1"/>', '<mesh filename="a" scale="nan 1 1"/>']
)
def test_a_size_that_is_not_finite_names_its_link(shape: str) -> None:
    with pytest.raises(InvalidRobotError, match=r'<link name="base">.*not finite'):
        read_visuals(shaped(shape))


def test_an_origin_that_is_not_finite_names_its_link() -> None:
    with pytest.raises(InvalidRobotError, match='<link name="base">: origin'):
        read_visuals(shaped('<sphere radius="1"/>', '<origin xyz="nan 0 0"/>'))


def test_a_file_is_read_as_its_text_is(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(shaped('<sphere radius="2"/>'))
    assert read_visuals(path) == read_visuals(str(path)) == [Visual("base", Sphere(2.0))]

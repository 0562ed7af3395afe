from importlib.metadata import version

import pytest

import tfbus


def test_dir_shows_the_public_names_and_the_version() -> None:
    assert dir(tfbus) == sorted([*tfbus.__all__, "__version__"])
    assert all(hasattr(tfbus, name) for name in dir(tfbus))


def test_the_version_is_that_of_the_installed_package() -> None:
    assert tfbus.__version__ == version("tfbus")


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'tfbus' has no attribute 'Transfrom'"):
        tfbus.Transfrom  # noqa: B018

"""The examples in docstrings are true, and public things have docstrings."""

import doctest
import importlib
import inspect
import pkgutil

import pytest

import tfbus

MODULES = [module.name for module in pkgutil.walk_packages(tfbus.__path__, "tfbus.") if module.name != "tfbus._build"]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_are_true(name: str) -> None:
    names = {public: getattr(tfbus, public) for public in tfbus.__all__}
    assert doctest.testmod(importlib.import_module(name), extraglobs=names).failed == 0


@pytest.mark.parametrize("name", tfbus.__all__)
def test_everything_public_has_a_docstring(name: str) -> None:
    thing = getattr(tfbus, name)
    if not (inspect.isclass(thing) or inspect.isroutine(thing)):
        return
    assert thing.__doc__
    if inspect.isclass(thing):
        for method, value in vars(thing).items():
            if not method.startswith("_") and (inspect.isroutine(value) or isinstance(value, property)):
                assert value.__doc__, f"{name}.{method}"

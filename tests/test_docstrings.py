"""The examples in docstrings are true, and public things have docstrings."""

import doctest
import importlib
import inspect
from pathlib import Path

import tfbus


def test_the_examples_of_every_module_are_true() -> None:
    names = {public: getattr(tfbus, public) for public in tfbus.__all__}
    package = Path(tfbus.__file__).parent
    results = []
    for path in package.rglob("*.py"):
        if ">>>" in path.read_text(encoding="utf-8"):
            module = ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__")
            results.append(doctest.testmod(importlib.import_module(module), extraglobs=names))
    assert [result for result in results if result.failed or not result.attempted] == []
    assert len(results) > 3


def test_everything_public_has_a_docstring() -> None:
    missing = []
    for name in tfbus.__all__:
        thing = getattr(tfbus, name)
        if inspect.isclass(thing):
            methods = {f"{name}.{method}": value for method, value in vars(thing).items() if not method.startswith("_")}
            missing += [
                method
                for method, value in methods.items()
                if (inspect.isroutine(value) or isinstance(value, property)) and not value.__doc__
            ]
        if (inspect.isclass(thing) or inspect.isroutine(thing)) and not thing.__doc__:
            missing.append(name)
    assert missing == []

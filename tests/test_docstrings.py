"""The examples in docstrings are true, and public things have docstrings."""

import ast
import asyncio
import doctest
import functools
import importlib
import inspect
import re
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.recorded import SMALL

import tfbus

WITH_EXTRAS = {
    "tfbus.recording.convert": "mcap",
    "tfbus.recording.examine": "rosbags",
    "tfbus.recording.header_stamps": "rosbags",
    "tfbus.recording.joint_states": "rosbags",
    "tfbus.recording.player": "rosbags",
    "tfbus.recording.recorder": "mcap",
    "tfbus.recording.recording": "rosbags",
    "tfbus.recording.summary": "rosbags",
    "tfbus.robot.model": "urdf_parser_py",
}
"""Modules whose examples need an extra, and a package of it."""

OPTIONAL = {"scipy": "scipy", "to_dataframe": "pandas"}
"""Words in examples that run only where a package is installed."""

DOORS = [f"tfbus.{room}" for room in ("analysis", "axes", "camera", "earth", "links", "recording", "robot", "testing")]
DOORS += ["tfbus", "tfbus.web"]

ROOT = Path(__file__).parents[1]

QUESTION = re.compile(r'^ *r?"""(?:What|Where|How|Who|Whom|Whose|Which|Why|When)(?:ever)?\b.*', re.MULTILINE)

CLAUSE = r"(?:(?:What|Who)(?:ever)?|Whom|Whose|Those (?:that|whom?|of|in|by|with)|That (?:of|which)|Of (?:which|whom))"
CLAUSE_FIRST = re.compile(rf'(?:^ *(?:r?"""|# |[*#>|] *)?\**|[.:;|] \**){CLAUSE}\b.*', re.MULTILINE)


def sentences(pattern: re.Pattern[str], *places: str, suffix: str = ".py") -> dict[str, list[str]]:
    """The lines that a pattern finds in some files and folders of the checkout, by file."""
    found = [path for place in places for path in ROOT.glob(place)]
    paths = [path for each in found for path in (each.rglob(f"*{suffix}") if each.is_dir() else [each])]
    assert len(paths) >= len(places)
    hits = {str(path.relative_to(ROOT)): pattern.findall(path.read_text(encoding="utf-8")) for path in paths}
    return {path: lines for path, lines in hits.items() if lines}


@pytest.fixture
def recordings(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Run an example in the folder of the recordings, which it reads by name; its new folders are removed."""
    monkeypatch.chdir(SMALL.parent)
    # Not tmp_path: the path of a socket is short.
    with tempfile.TemporaryDirectory() as folder:
        monkeypatch.setattr(tempfile, "tempdir", folder)
        yield


def modules_with_examples() -> list[str]:
    package = Path(tfbus.__file__).parent
    paths = [path for path in package.rglob("*.py") if ">>>" in path.read_text(encoding="utf-8")]
    return [
        ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__") for path in paths
    ]


def results_of(module: str) -> doctest.TestResults:
    """The results of all examples of a module. An example may await: those of one docstring share an event loop."""
    names = {"np": np, **{public: getattr(tfbus, public) for public in tfbus.__all__}}
    runner = doctest.DocTestRunner()
    for test in doctest.DocTestFinder(exclude_empty=True).find(importlib.import_module(module), extraglobs=names):
        source = "".join(example.source for example in test.examples)
        if any(word in source and find_spec(package) is None for word, package in OPTIONAL.items()):
            continue
        with asyncio.Runner() as loop:
            test.globs["_await"] = functools.partial(awaited, loop, test.globs)
            for example in test.examples:
                try:
                    compile(example.source, "<example>", "single")
                except SyntaxError:
                    example.source = f"_await({example.source!r})\n"
            runner.run(test)
    return runner.summarize(verbose=False)


def awaited(loop: asyncio.Runner, names: dict[str, Any], source: str) -> None:
    coroutine = eval(compile(source, "<example>", "single", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT), names)
    loop.run(coroutine)


def callables() -> dict[str, Any]:
    """The public classes, functions and methods, but for errors, by name."""
    found: dict[str, Any] = {}
    # The methods that the reference leaves out, because tfbus calls them itself.
    pages = [ROOT / "demos" / "guide" / "conf.py", *(ROOT / "demos" / "guide" / "reference").glob("*.rst")]
    left_out = re.findall(r"exclude-members\W+([a-z_, ]+)", " ".join(page.read_text("utf-8") for page in pages))
    internal = {name for names in left_out for name in names.split(", ")}
    for room in map(importlib.import_module, DOORS):
        own = [name for name, thing in vars(room).items() if getattr(thing, "__module__", "") == room.__name__]
        public = [(name, getattr(room, name)) for name in getattr(room, "__all__", own) if name[0] != "_"]
        for name, thing in public:
            if inspect.isfunction(thing):
                found[name] = thing
            elif inspect.isclass(thing) and not issubclass(thing, BaseException):
                found[name] = thing
                for method, value in vars(thing).items():
                    value = getattr(value, "__func__", value)
                    # The names of tf2, which raise an error, have no module.
                    if not method.startswith("_") and callable(value) and method not in internal:
                        found[f"{name}.{method}"] = value
    return found


@pytest.mark.usefixtures("recordings")
def test_the_examples_of_every_module_are_true() -> None:
    results = [results_of(module) for module in modules_with_examples() if module not in WITH_EXTRAS]
    assert [result for result in results if result.failed or not result.attempted] == []
    assert len(results) > 8


@pytest.mark.usefixtures("recordings")
@pytest.mark.parametrize(("module", "package"), WITH_EXTRAS.items())
def test_the_examples_that_need_an_extra_are_true(module: str, package: str) -> None:
    pytest.importorskip(package)
    result = results_of(module)
    assert (result.failed, result.attempted > 0) == (0, True)


def test_each_public_callable_has_an_example() -> None:
    found = callables()
    assert len(found) > 200
    assert [name for name, thing in found.items() if ">>> " not in (inspect.getdoc(thing) or "")] == []


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


def test_no_docstring_opens_with_a_question_word() -> None:
    assert sentences(QUESTION, "tfbus", "tests", "demos") == {}


def test_no_sentence_opens_with_a_clause_that_hides_its_subject() -> None:
    assert sentences(CLAUSE_FIRST, "tfbus", "tests", "demos") == {}


def test_no_sentence_of_the_guide_opens_with_a_clause_that_hides_its_subject() -> None:
    assert sentences(CLAUSE_FIRST, "demos/guide", "README.md", suffix=".md") == {}

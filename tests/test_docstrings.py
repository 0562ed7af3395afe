"""The examples in docstrings are true, and public things have docstrings."""

import doctest
import importlib
import inspect
import re
from pathlib import Path

import pytest
from support.recorded import SMALL

import tfbus

WITH_EXTRAS = {"tfbus.recording.recording": "rosbags"}
"""Modules whose examples need an extra, and a package of it."""

EXAMPLES = ["Bus", "Buffer", "Transform", "TransformArray", "TransformBroadcaster", "TransformTree", "do_transform"]
"""The names that people use most: their docstrings have examples."""

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
def recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run an example in the folder of the recordings, which it reads by name."""
    monkeypatch.chdir(SMALL.parent)


def modules_with_examples() -> list[str]:
    package = Path(tfbus.__file__).parent
    paths = [path for path in package.rglob("*.py") if ">>>" in path.read_text(encoding="utf-8")]
    return [
        ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__") for path in paths
    ]


def results_of(module: str) -> doctest.TestResults:
    names = {public: getattr(tfbus, public) for public in tfbus.__all__}
    return doctest.testmod(importlib.import_module(module), extraglobs=names)


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


@pytest.mark.parametrize("name", EXAMPLES)
def test_what_people_call_most_has_an_example(name: str) -> None:
    assert "Examples\n--------\n>>> " in (inspect.getdoc(getattr(tfbus, name)) or "")


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

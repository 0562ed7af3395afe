"""The site: the pages of this folder, and the reference, made from the docstrings of all public names.

Build it with ``sphinx-build -W -n -b html demos/guide "$(mktemp -d)"``; nothing is fetched from elsewhere.
"""

import importlib
import inspect
import re
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy.typing as npt
import numpydoc.xref
from docutils.nodes import Element, TextElement
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.pycode import ModuleAnalyzer

from tfbus.cli.application import COMMANDS, application

ScalarT = TypeVar("ScalarT")


class ArrayLike:
    """Stands in for numpy's, which signatures would show as the union of a dozen types."""


class NDArray(Generic[ScalarT]):
    """Stands in for numpy's, which signatures would show as an array of a shape and a dtype."""


# Before tfbus is imported, which evaluates its annotations then.
npt.ArrayLike = ArrayLike  # type: ignore[assignment]
npt.NDArray = NDArray  # type: ignore[assignment]

project = "tfbus"
author = "the authors of tfbus"
version = release = version_of("tfbus")

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc"]
nitpicky = True
nitpick_ignore = [
    ("py:obj", "anyio.move_on_after"),
    ("py:obj", "functools.partial"),
    ("py:obj", "functools.singledispatch"),
    ("py:obj", "math.inf"),
    ("py:obj", "lookupVelocity"),
    ("py:class", "anyio.CancelScope"),
    ("py:class", "collections.Counter"),
    ("py:class", "contextlib.AbstractContextManager"),
    ("py:class", "datetime.datetime"),
    ("py:class", "matplotlib.figure.Figure"),
    ("py:class", "numpy.random._generator.Generator"),
    ("py:class", "os.PathLike"),
    ("py:class", "pathlib.Path"),
]
nitpick_ignore_regex = [
    ("py:class", r"(ArrayLike|NDArray|(collections\.abc|numpy)\.\w+)"),
    # The names of type aliases, and of the keywords of a method.
    ("py:class", r"(.*\.)?(AtLike|StampLike|StampsLike|StampsAs|Numbers|Changes)"),
    # The error of a message of a recording that cannot be read.
    ("py:class", r"tfbus\..*\.MalformedMessageError"),
    # The parts of a recording for code that reads it in blocks.
    ("py:class", r"tfbus\.recording\.(recording\.(Decoded)?Block|formats\.\w+\.RawTransform)"),
    # An object with a tree, such as a buffer, whose static frames are saved.
    ("py:class", r"tfbus\.recording\.static_frames\.HasTree"),
    # The methods of a buffer that a broadcaster uses.
    ("py:class", r"tfbus\.bus\.broadcaster\.Awaits"),
    # The policy of a question that waits, which a program reads from it and never makes.
    ("py:class", r"tfbus\.tree\.lookup\.Policy"),
    # An object with a method `close`.
    ("py:class", r"tfbus\.web\._Closable"),
    # The parts of a link, and the follower of a clock.
    ("py:class", r"tfbus\.links\.(endpoint\.(HearsTime|Endpoint)|seams\.Wire|lookups\.Serving)"),
    ("py:class", r"tfbus\._aio\.turn_budget\.TurnBudget"),
    ("py:class", r"tfbus\.links\.(domain\.DomainOptions|ros\.\w+\.(RosCarrier|RosOptions))"),
    # Sphinx splits the parameters of such types.
    ("py:class", r"[\w.]+\[\w+"),
]

html_theme = "furo"
html_title = f"tfbus {version}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_copy_source = False
html_show_copyright = False
html_theme_options = {"navigation_with_keys": True}

# It would make one dash of the two before an option.
smartquotes = False

# The anchors that GitHub gives to headings, so that a link works there and here.
myst_heading_anchors = 3

autodoc_default_options = {
    "members": True,
    # Members of Python's own classes are not documented again.
    "inherited-members": "BaseException, Enum, tuple, object",
    # The parts of a link call these.
    "exclude-members": "receive, send_soon, stir, is_behind, serve, lookups",
    "member-order": "bysource",
}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
numpydoc_show_class_members = False
default_role = "py:obj"

# The import paths in the reference, the preferred one first. Modules may move below them.
PATHS = (
    "tfbus",
    "tfbus.links",
    "tfbus.links.zenoh",
    "tfbus.recording",
    "tfbus.analysis",
    "tfbus.testing",
    "tfbus.web",
    "tfbus.data",
)


def public_names() -> dict[int, str]:
    """By the identity of each public object, the name under which the reference has it."""
    names: dict[int, str] = {}
    for path in PATHS:
        module = importlib.import_module(path)
        own = [name for name, thing in vars(module).items() if getattr(thing, "__module__", None) == path]
        for name in getattr(module, "__all__", own):
            names.setdefault(id(getattr(module, name)), f"{path}.{name}")
    return names


NAMES = public_names()
BARE = {name.rpartition(".")[2]: name for name in NAMES.values()}

# Python's own types are no links, for there is nothing here to link to.
numpydoc.xref.DEFAULT_LINKS.clear()
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = BARE


def words() -> Iterator[str]:
    """The words that docstrings may name without a reference: every argument and attribute of something public."""
    for name in NAMES.values():
        thing = find(name)
        members = [member for key, member in inspect.getmembers(thing) if not key.startswith("_") or key == "__init__"]
        for member in (thing, *(members if inspect.isclass(thing) else ())):
            if inspect.isfunction(member) or inspect.ismethod(member):
                yield from inspect.signature(member).parameters
            for names in re.findall(r"^ *(\w+(?:, \w+)*) : ", inspect.getdoc(member) or "", re.MULTILINE):
                yield from names.split(", ")
        yield from (key for key, member in inspect.getmembers(thing) if isinstance(member, property))
        yield from getattr(thing, "__annotations__", ())


def find(dotted: str) -> object:
    """The object that an import path and attributes lead to; None if there is none."""
    path, _, rest = dotted.partition(".")
    thing: object = importlib.import_module(path)
    for part in rest.split(".") if rest else ():
        path = f"{path}.{part}"
        try:
            thing = getattr(thing, part) if hasattr(thing, part) else importlib.import_module(path)
        except ImportError:
            return None
    return thing


WORDS = frozenset(words())

GUIDE = Path(__file__).parent
DEMOS = sorted(GUIDE.parent.glob("*.py"))
DOMAIN_HEADING = "Options of all commands that join a domain"


def complete(app: Sphinx, name: str, source: list[str]) -> None:  # noqa: ARG001 - Sphinx names the arguments
    """Add to a page what is made from the code; links to demos lead to the page of demos."""
    if name in MADE:
        source[0] += MADE[name]()
    else:
        source[0] = re.sub(r"\]\(\.\./(\w+)\.py\)", r"](demos.md#\1py)", source[0])


def demos() -> str:
    """All demos, one after another."""
    return "".join(f"\n## {path.name}\n\n```{{literalinclude}} ../{path.name}\n```\n" for path in DEMOS)


def commands() -> str:
    """The options of all commands; those that most commands have are told once."""
    pages = {name: command_page(name) for name in COMMANDS}
    bullet = re.compile(r"^\* `--.*\n(?:    .*\n)*", re.MULTILINE)
    counts = Counter(line for page in pages.values() for line in bullet.findall(page))
    shared = [line for line, count in counts.items() if count > len(COMMANDS) / 2]
    for name, page in pages.items():
        own = bullet.sub(lambda found: "" if found[0] in shared else found[0], page)
        if own != page:
            # A heading of options may have none left.
            own = re.sub(r"\n\*\*[^*\n]+\*\*:\n\s*(?=\n\*\*|\Z)", "\n", own)
            own += f"\nIt joins a domain: see [{DOMAIN_HEADING}](#{DOMAIN_HEADING.lower().replace(' ', '-')}).\n"
        pages[name] = own
    return "\n".join([*pages.values(), f"## {DOMAIN_HEADING}\n", "".join(shared)])


def command_page(name: str) -> str:
    """The help of a command as Markdown."""
    text: str = application(name)[name].generate_docs("markdown", heading_level=2)
    # The command line shows neither an option that empties another one, nor a default that is nothing.
    text = re.sub(r", --empty-[\w-]+(?=`:)| \*\[default: (?:False|\(\)|\"\")\]\*", "", text)
    text = re.sub(r"^Example: (.*)$", r"```console\n\1\n```", text, flags=re.MULTILINE)
    return "\n" + text.replace(f"## {name}", f"## tfbus {name}", 1).replace(f"\n{name} ", f"\ntfbus {name} ", 1)


def summaries() -> str:
    """A line for each name of the reference, page by page."""
    parts = []
    for page in re.findall(r"^   (\w+)$", (GUIDE / "reference" / "index.rst").read_text(), re.MULTILINE):
        text = (GUIDE / "reference" / f"{page}.rst").read_text()
        title = text.partition("\n")[0]
        lines = []
        for name, written in re.findall(r"^\.\. (?:auto\w+|data):: ([\w.]+).*\n(?:\n   (\w.*))?", text, re.MULTILINE):
            name = name if "." in name else f"tfbus.{name}"
            summary = written or (inspect.getdoc(find(name)) or "").partition("\n\n")[0]
            summary = re.sub(r"(?<!`)`([^`]+)`(?!`)", r"``\1``", " ".join(summary.split()))
            lines.append(f"* :obj:`{name}`: {summary}")
        title = f":doc:`{title} <{page}>`"
        parts.append(f"{title}\n{'-' * len(title)}\n\n" + "\n".join(lines) + "\n")
    return "\n\n" + "\n".join(parts)


MADE = {"commands": commands, "demos": demos, "reference/index": summaries}


def resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: TextElement) -> Element | None:
    """The target of a name that the reference has under another name, or not at all.

    Annotations have names from inner modules, such as ``tfbus.stamps.Latest``: they are found by identity. Docstrings
    of one import path use names of another, such as `SimulatedClock` in ``tfbus.testing``. Arguments and attributes
    are code and link to nothing.
    """
    if node.get("refdomain") != "py":
        return None
    target: str = node["reftarget"]
    if target.startswith("tfbus."):
        thing = find(target)
        if isinstance(thing, TypeVar):
            return content
        public = NAMES.get(id(thing))
    else:
        first, _, attribute = target.partition(".")
        public = BARE.get(first)
        if public is not None and attribute and attribute not in WORDS:
            public = f"{public}.{attribute}"
    if public is not None and public != target:
        domain = env.get_domain("py")
        found: Element | None = domain.resolve_xref(env, node["refdoc"], app.builder, "obj", public, node, content)
        return found
    return content if target in WORDS else None


def analyze(self: ModuleAnalyzer) -> None:
    """Read a module without the overloads of lookups, which say less than the one signature that has all arguments."""
    read_with_overloads(self)
    self.overloads = {
        name: found for name, found in self.overloads.items() if not any("covariance" in s.parameters for s in found)
    }


read_with_overloads = ModuleAnalyzer.analyze
analyzer: Any = ModuleAnalyzer
analyzer.analyze = analyze


def setup(app: Sphinx) -> None:
    app.connect("missing-reference", resolve)
    app.connect("source-read", complete)

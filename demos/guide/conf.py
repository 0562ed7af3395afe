"""The site: the pages of this folder, and the reference, made from the docstrings of all public names.

Build it with ``sphinx-build -W -n -b html demos/guide "$(mktemp -d)"``; nothing is fetched from elsewhere.
"""

import importlib
from importlib.metadata import version as version_of

from docutils.nodes import Element, TextElement
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

project = "tfbus"
author = "the authors of tfbus"
version = release = version_of("tfbus")

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc"]
nitpicky = True

html_theme = "furo"
html_title = f"tfbus {version}"
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}

# The anchors that GitHub gives to headings, so that a link works there and here.
myst_heading_anchors = 3

autodoc_default_options = {
    "members": True,
    # What Python's own classes have is not told again.
    "inherited-members": "BaseException, Enum, tuple, object",
    "member-order": "bysource",
}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
numpydoc_show_class_members = False
default_role = "py:obj"

# The import paths of which the reference tells, the preferred one first. Modules may move below them.
PATHS = ("tfbus", "tfbus.links.zenoh", "tfbus.recording", "tfbus.testing", "tfbus.data")


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

numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = {name.rpartition(".")[2]: name for name in NAMES.values()}


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


def resolve_by_identity(app: Sphinx, env: BuildEnvironment, node: pending_xref, contnode: TextElement) -> Element | None:
    """Link a name that annotations have from an inner module, such as ``tfbus.stamps.Latest``, to the public one."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py" or not target.startswith("tfbus."):
        return None
    public = NAMES.get(id(find(target)))
    if public is None or public == target:
        return None
    domain = env.domains.python_domain
    return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", public, node, contnode)


def setup(app: Sphinx) -> None:
    app.connect("missing-reference", resolve_by_identity)

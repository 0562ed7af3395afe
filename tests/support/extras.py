"""The extras of tfbus that are not installed: a test that needs one is skipped with its name."""

import importlib.util
import re
from collections.abc import Iterator

EXTRAS = {
    "bag": ("lz4", "mcap", "rosbags", "ruamel", "zstandard"),
    "cli": ("cyclopts", "rich", "trio"),
    "dds": ("cyclonedds",),
    "foxglove": ("foxglove", "mcap_protobuf"),
    "parquet": ("pyarrow",),
    "plot": ("matplotlib",),
    "rosbridge": ("cbor2", "wsproto"),
    "urdf": ("urdf_parser_py",),
    "view": ("collada", "trimesh", "wsproto"),
    "web": ("fastapi", "uvicorn", "websockets"),
    "zenoh": ("zenoh",),
    "trio": ("trio",),
    "test": ("httpx", "uvloop"),
    "thorough": (
        "evo",
        "fastapi",
        "ipykernel",
        "jupyter_client",
        "pandas",
        "playwright",
        "pyright",
        "pytest_cov",
        "scipy",
        "zenoh_ros2_sdk",
    ),
}
"""The packages of each extra, by the names under which they are imported."""

_PACKAGE = re.compile(r"No module named '(\w+)|could not import '(\w+)")
_ADVICE = re.compile(r'"tfbus\[([\w,]+)\]"')


def absent_extra(error: BaseException | None) -> str | None:
    """The extra that an error, or what has led to it, asks for and that is not installed."""
    for message in _messages(error):
        packages = {name for match in _PACKAGE.findall(message) for name in match if name}
        advised = {extra for extras in _ADVICE.findall(message) for extra in extras.split(",")}
        for extra in EXTRAS:
            absent = [package for package in EXTRAS[extra] if importlib.util.find_spec(package) is None]
            if absent and (extra in advised or packages.intersection(absent)):
                return extra
    return None


def _messages(error: BaseException | None) -> Iterator[str]:
    """The message of an error, then those of its parts, its cause and its context, down to the first."""
    if error is None:
        return
    yield str(error)
    if isinstance(error, BaseExceptionGroup):
        for part in error.exceptions:
            yield from _messages(part)
    yield from _messages(error.__cause__ or error.__context__)

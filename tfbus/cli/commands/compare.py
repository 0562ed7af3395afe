"""``tfbus compare``."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tfbus.cli.arguments import CsvFlag, Duration, Flag, JsonFlag, UsageError
from tfbus.cli.commands.plot import distinct_names, draw_picture, picture_kind
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import (
    Column,
    csv_name,
    csv_writer,
    fitted,
    table_lines,
    terminal_width,
    warn,
)
from tfbus.cli.recordings import DEFAULT_TOPICS, TopicOptions, load_tree

with lazy_imports():
    from tfbus.analysis import Comparison
    from tfbus.analysis.compare import compare as compare_trees
    from tfbus.tree.tree import TransformTree

_SHOWN = 5
_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
_IMPORTANCE = (6, 4, 2, 1, 3, 5)
_COLUMNS = (
    Column("error"),
    Column("unit"),
    *(Column(name, True, importance) for name, importance in zip(_STATISTICS, _IMPORTANCE, strict=True)),
)


def compare(
    reference: Path,
    estimate: Path,
    /,
    *,
    pair: tuple[str, ...] = (),
    scale: Flag = False,
    max_difference: Duration = 0.01,
    delta: int = 1,
    plot: Path | None = None,
    as_csv: CsvFlag = False,
    as_json: JsonFlag = False,
    topics: TopicOptions = DEFAULT_TOPICS,
) -> None:
    """Compare the trajectory of a frame in two recordings: absolute and relative pose error, aligned and not.

    Example: tfbus compare truth.tum slam.mcap --pair map:base_link=odom:camera --plot errors.png

    Parameters
    ----------
    reference
        The recording that is taken as the truth; also a trajectory of TUM, KITTI or EuRoC, of base_link in map.
    estimate
        The recording to judge.
    pair
        As TARGET:SOURCE, the frames whose transform is compared; with =TARGET:SOURCE behind it, these are their names
        in the estimate. May be given several times. By default, every frame that moves in both recordings, in its
        parent.
    scale
        When the estimate is aligned, scale it as well.
    max_difference
        The greatest difference of two stamps that are compared, in s.
    delta
        The number of poses of each step for the relative error.
    plot
        Draw the errors of one pair, over time and on the map, to this file as well: .png, .svg or .pdf. They are the
        errors after alignment, if that is possible.
    as_csv
        Print the errors over time, in m and rad, without alignment; a relative error is empty where no step ends.
    as_json
        Print a JSON object instead.
    """
    if as_csv and as_json:
        raise UsageError("--csv and --json are two ways to print the same: give one of them")
    kind = None if plot is None else picture_kind(plot)
    wanted, judged = (load_tree(file, topics, named=True)[0] for file in (reference, estimate))
    found = {}
    pairs = _pairs(pair) if pair else _moving_pairs(wanted, judged)
    if plot is not None and len(pairs) > 1:
        raise UsageError(f"--plot draws one pair, give --pair with one of {', '.join(list(pairs)[:_SHOWN])}")
    for text, (target, source, *others) in pairs.items():
        for aligned in (False,) if as_csv else (False, True):
            try:
                found[text, aligned] = compare_trees(
                    wanted,
                    judged,
                    target,
                    source,
                    estimate_frames=(others[0], others[1]) if others else None,
                    align=aligned,
                    scale=scale,
                    max_difference=max_difference,
                    delta=delta,
                )
            except ValueError as error:
                if not aligned and pair:
                    raise UsageError(str(error)) from None
                warn(f"{text}: {error}")
    if plot is not None and found:
        (text, _), last = list(found.items())[-1]
        names = distinct_names(reference, estimate)
        draw_picture(lambda plots, figure: plots.plot_errors(last, text, names=names, figure=figure), plot, kind)
    if as_csv:
        _print_csv(found)
    elif as_json:
        print(json.dumps([_to_json(text, each) for (text, _), each in found.items()], indent=2))
    else:
        _print_tables(found)


def _pairs(texts: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Target and source of each pair, and their names in the estimate behind them if they are others."""
    pairs = {}
    for text in texts:
        names = tuple(name for pair in text.split("=") for name in pair.split(":"))
        if len(names) not in (2, 4) or text.count("=") != len(names) // 2 - 1 or not all(names):
            raise UsageError(
                f"a pair is TARGET:SOURCE, such as map:base_link, or with other names in the estimate "
                f"map:base_link=odom:camera, not {text!r}"
            )
        pairs[text] = names
    return pairs


def _moving_pairs(wanted: TransformTree, judged: TransformTree) -> dict[str, tuple[str, ...]]:
    """The frames that move in both trees, each with its parent in the first one."""
    moving = {edge.child for edge in judged.edges() if not edge.static}
    known = set(judged.frames())
    pairs: dict[str, tuple[str, ...]] = {
        f"{edge.parent}:{edge.child}": (edge.parent, edge.child)
        for edge in wanted.edges()
        if not edge.static and edge.child in moving and edge.parent in known
    }
    if not pairs:
        raise UsageError(
            "no frame moves in both recordings under one name: give --pair TARGET:SOURCE=TARGET:SOURCE, the second "
            "ones as the estimate names them"
        )
    return pairs


def _rows(found: Comparison) -> Iterator[tuple[str, str, Any]]:
    """Name, unit and statistics of each kind of error."""
    for kind, errors in (("absolute", found.absolute), ("relative", found.relative)):
        if len(errors.stamps):
            translation, rotation = errors.statistics()
            yield f"{kind} translation", "m", translation
            yield f"{kind} rotation", "rad", rotation


def _to_json(text: str, found: Comparison) -> dict[str, Any]:
    alignment = found.alignment
    return {
        "pair": text,
        "poses": found.poses,
        "of": found.of,
        "alignment": None
        if alignment is None
        else {
            "translation": alignment.transform.translation,
            "rotation": alignment.transform.rotation,
            "scale": alignment.scale,
        },
        **{name.replace(" ", "_"): asdict(statistics) for name, _, statistics in _rows(found)},
    }


def _print_tables(found: dict[tuple[str, bool], Comparison]) -> None:
    for number, ((text, aligned), each) in enumerate(found.items()):
        how = "aligned" if aligned else "not aligned"
        if each.alignment is not None and each.alignment.scale != 1.0:
            how += f" and scaled by {each.alignment.scale:.6g}"
        if number:
            print()
        heading = f"{text}, {how}: {each.poses:,} poses of {each.of[0]:,} and {each.of[1]:,}"
        print(fitted(heading))
        rows = [
            (name, unit, *(f"{getattr(statistics, key):.6g}" for key in _STATISTICS))
            for name, unit, statistics in _rows(each)
        ]
        for line in table_lines(_COLUMNS, rows, terminal_width()):
            print(line)


def _print_csv(found: dict[tuple[str, bool], Comparison]) -> None:
    out = csv_writer()
    out.writerow(
        (
            "pair",
            "stamp_ns",
            "absolute_translation_m",
            "absolute_rotation_rad",
            "relative_translation_m",
            "relative_rotation_rad",
        )
    )
    for (text, _), each in found.items():
        relative = each.relative
        steps = dict(
            zip(
                relative.stamps.tolist(),
                zip(relative.translation.tolist(), relative.rotation.tolist(), strict=True),
                strict=True,
            )
        )
        absolute = each.absolute
        for stamp, distance, angle in zip(
            absolute.stamps.tolist(), absolute.translation.tolist(), absolute.rotation.tolist(), strict=True
        ):
            out.writerow((csv_name(text), stamp, distance, angle, *steps.get(stamp, ("", ""))))

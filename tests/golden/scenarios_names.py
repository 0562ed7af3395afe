"""Invalid samples and invalid names in questions, which are refused."""

import math

from steps import (
    SECOND,
    Scenario,
    Step,
    can,
    deviates,
    frames,
    known,
    latest,
    lookup,
    parent,
    placed,
    sample,
    static,
    travel,
)

NAN, INF = math.nan, math.inf
UNKNOWN = "UnknownFrameError"


def scenarios() -> list[Scenario]:
    """All of them."""
    return [_invalid_samples(), _quaternions(), _infinity(), _names(), _no_parent(), _questions(), _depth()]


def _invalid_samples() -> Scenario:
    """NoInsertOnSelfTransform, NoInsertWithNan, NoInsertWithNoFrameID, NoInsertWithNoParentID, setTransformFail."""
    steps = [
        sample("a", "a", SECOND),
        static("a", "a"),
        sample("a", "", SECOND),
        sample("a", "/", SECOND),
        sample("", "b", SECOND),
        sample("/", "b", SECOND),
        sample("", "", SECOND),
        sample("", "", 0, 0.0, (0.0, 0.0, 0.0, 0.0)),
    ]
    numbers = range(4)
    steps += [sample("a", "b", SECOND, [NAN if at == place else 1.0 for at in numbers[:3]]) for place in numbers[:3]]
    steps += [sample("a", "b", SECOND, 1.0, [NAN if at == place else 0.5 for at in numbers]) for place in numbers]
    steps += [static("a", "b", NAN), frames(), known("a"), known("b"), can("a", "b")]
    return Scenario("invalid samples", [*steps, sample("a", "b", SECOND), known("a"), lookup("a", "b", SECOND)])


def _quaternions() -> Scenario:
    """A norm of exactly 1 is the same in all; then the tolerance's edges, whose squares are 1.0099 and 1.0101."""
    scaled = [math.sqrt(square) for square in (1.0099, 1.0101)]
    steps = [
        sample("a", "zero", SECOND, 0.0, (0.0, 0.0, 0.0, 0.0)),
        sample("a", "double", SECOND, 0.0, (0.0, 0.0, 0.0, 2.0)),
        sample("a", "half", SECOND, 0.0, (0.5, 0.0, 0.0, 0.0)),
        sample("a", "minus", SECOND, 0.0, (0.0, 0.0, 0.0, -1.0)),
        sample("a", "tiny", SECOND, 0.0, (0.0, 1e-9, 0.0, 0.0)),
        known("zero"),
        known("double"),
        lookup("a", "minus", SECOND),
        sample("a", "b", SECOND, 3.0, (0.0, 0.0, 0.0, scaled[0])),
        sample("b", "c", SECOND, 3.0),
        deviates(lookup("a", "c", SECOND), "near-unit quaternion", placed(SECOND, 6.0)),
        deviates(sample("a", "far", SECOND, 3.0, (0.0, 0.0, 0.0, scaled[1])), "norm of 1 %", "stored"),
        deviates(lookup("a", "far", SECOND), "norm of 1 %", placed(SECOND, 3.0)),
        deviates(sample("a", "below", SECOND, 3.0, (0.0, 0.0, 0.991, 0.0)), "norm of 1 %", "stored"),
        sample("a", "beyond", SECOND, 3.0, (0.0, 0.0, 0.989, 0.0)),
        sample("a", "above", SECOND, 3.0, (0.0, 0.0, 1.011, 0.0)),
    ]
    return Scenario("quaternions", steps)


def _infinity() -> Scenario:
    steps: list[Step] = [
        deviates(sample("a", "b", SECOND, (INF, 0.0, 0.0)), "infinity", "invalid"),
        deviates(sample("a", "c", SECOND, (0.0, 0.0, -INF)), "infinity", "invalid"),
        deviates(static("a", "d", (0.0, INF, 0.0)), "infinity", "invalid"),
        deviates(known("b"), "infinity", tfbus=False),
        sample("a", "e", SECOND, 0.0, (INF, 0.0, 0.0, 0.0)),
        deviates(sample("a", "e", SECOND, 1e300), "not physical", "invalid"),
        deviates(lookup("a", "e", SECOND), "not physical", "UnknownFrameError"),
    ]
    return Scenario("infinity", steps)


def _names() -> Scenario:
    """tf2 cuts one leading slash off; else any name is good."""
    steps = [
        deviates(sample("/a", "b", SECOND), "slash", "invalid"),
        deviates(sample("a", "/c", SECOND), "slash", "invalid"),
        deviates(known("a"), "slash", tfbus=False),
        deviates(lookup("a", "c", SECOND), "slash", UNKNOWN),
    ]
    odd = ["base link", "UPPER", "upper", "küche", "腕", "x/y", "tail/", " ", "0", "null", "a\\b", 'a"b']
    steps += [sample("root", name, SECOND, float(number)) for number, name in enumerate(odd)]
    steps += [lookup(name, "root", SECOND) for name in odd] + [known(name) for name in odd]
    return Scenario("names", steps)


def _no_parent() -> Scenario:
    """tf1's NO_PARENT_SET and TransformThroughNO_PARENT: tf2's own word for the parent of a root."""
    steps = [
        sample("a", "b", SECOND, 1.0),
        sample("NO_PARENT", "a", SECOND, 2.0),
        sample("NO_PARENT", "island", SECOND, 3.0),
        lookup("a", "b", SECOND),
        deviates(lookup("NO_PARENT", "b", SECOND), "reserved name", placed(SECOND, 3.0)),
        deviates(lookup("a", "island", SECOND), "reserved name", placed(SECOND, 1.0)),
        deviates(can("b", "island", SECOND), "reserved name", tfbus=True),
        sample("x", "y", SECOND),
        deviates(lookup("a", "y", SECOND), "reserved name", "DisconnectedError"),
        deviates(lookup("island", "y", 2 * SECOND), "disconnected first", "DisconnectedError"),
    ]
    return Scenario("a frame named NO_PARENT", steps)


def _questions() -> Scenario:
    """lookup.invalid_arguments and can.invalid_arguments; an unknown frame in itself."""
    steps = [sample("a", "b", SECOND, 1.0)]
    for bad in ("", "/a", "/b", "/"):
        for target, source in ((bad, "b"), ("a", bad)):
            steps.append(deviates(lookup(target, source, SECOND), "query name", UNKNOWN))
            steps.append(can(target, source, SECOND))
        steps.append(deviates(travel(bad, "b", SECOND, SECOND, "a"), "query name", UNKNOWN))
        steps.append(deviates(travel("a", "b", SECOND, SECOND, bad), "query name", UNKNOWN))
        steps.append(deviates(lookup(bad, bad, SECOND), "unknown in itself", UNKNOWN))
        steps.append(deviates(can(bad, bad, SECOND), "unknown in itself", tfbus=False))
    steps += [lookup("a", "zz", SECOND), lookup("zz", "a"), lookup("zz", "yy", SECOND), lookup("A", "b", SECOND)]
    steps += [can("a", "zz"), can("zz", "yy", SECOND), latest("zz", "a"), latest("a", "zz")]
    steps += [deviates(lookup("zz", "zz", SECOND), "unknown in itself", UNKNOWN)]
    steps += [deviates(can("zz", "zz", SECOND), "unknown in itself", tfbus=False)]
    steps += [deviates(parent("zz"), "root of nothing", UNKNOWN)]
    return Scenario("questions with bad names", steps)


def _depth() -> Scenario:
    """A thousand links are as many as tf2 climbs."""
    steps = [static(f"f{number}", f"f{number + 1}", 1.0) for number in range(1001)]
    steps += [lookup("f0", "f1000", SECOND), lookup("f1", "f1001", SECOND), lookup("f500", "f0", SECOND)]
    steps += [deviates(lookup("f0", "f1001", SECOND), "depth", placed(SECOND, 1001.0))]
    steps += [deviates(lookup("f1001", "f0", SECOND), "depth", placed(SECOND, -1001.0))]
    return Scenario("depth", steps)

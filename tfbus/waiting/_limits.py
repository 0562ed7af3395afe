"""The limits of a waiting lookup: how far each edge of its path may go on before it loses the lookup's stamp."""

from tfbus.errors import DisconnectedError, ExtrapolationError, GapError, UnknownFrameError
from tfbus.stamps import STAMP_MAX, Latest
from tfbus.tree.extrapolation import read_stamp
from tfbus.tree.forest import Forest
from tfbus.tree.history import FrameHistory
from tfbus.tree.policy import Policy
from tfbus.tree.question import Question

Limits = list[tuple[str, int]]


def limits_of(forest: Forest, question: Question, blocking: str | None) -> Limits:
    """The moving edges of a question, each with a limit in ns: a newer sample of it may mean that no answer will come.

    An edge that keeps all samples has no limit. Neither has a lookup at `LATEST`, because its stamp is never too old.
    Only the thread that fills the forest may call this.

    Parameters
    ----------
    forest : Forest
    question : Question
    blocking : str or None
        An edge to leave out, because each of its samples is noticed anyway.
    """
    target, source, fixed = question.target, question.source, question.fixed
    if fixed is None:
        return _limits_at(forest, target, source, question.at, question.policy, blocking)
    return [
        *_limits_at(forest, target, fixed, question.at, question.policy, blocking),
        *_limits_at(forest, fixed, source, question.source_at, question.policy, blocking),
    ]


def _limits_at(
    forest: Forest, target: str, source: str, at: int | Latest | None, policy: Policy | None, blocking: str | None
) -> Limits:
    if at is None or isinstance(at, Latest):
        return []
    path = forest.paths.find(target, source)
    edges = _edges(forest, target, source, at) if path is None or path.root in forest.frames else path.moving
    window = STAMP_MAX if forest.window is None else forest.window
    limits = []
    asked = at
    if policy is not None:
        at = min(at + policy.tolerance, STAMP_MAX)
    for edge in edges:
        if edge.child == blocking:
            continue
        before, after = edge.around(at)
        if before is None:
            # The first sample decides, or has decided.
            limit = at
        elif after is not None:
            # Until the sample before the stamp leaves the window.
            limit = before + window
            if policy is not None and policy.max_gap is not None and _is_in_gap(edge, asked, policy):
                limit = at
        else:
            # Until a sample after the stamp comes, and the one before it has left the window or is too far away.
            near = window if policy is None or policy.max_gap is None else min(window, policy.max_gap)
            limit = max(before + near, at)
        if limit < STAMP_MAX:
            limits.append((edge.child, limit))
    return limits


def _is_in_gap(edge: FrameHistory, at: int, policy: Policy) -> bool:
    try:
        read_stamp(edge, at, policy)
    except GapError:
        return True
    except ExtrapolationError:
        pass
    return False


def _edges(forest: Forest, target: str, source: str, at: int) -> tuple[FrameHistory, ...]:
    """The moving edges that decide whether there will be an answer."""
    with forest.lock:
        try:
            path = forest.find_path(target, source, at)
        except UnknownFrameError:
            return ()
        except DisconnectedError as error:
            # A loop ends when one of its edges loses the stamp.
            loop = [forest.frames[child] for child in dict.fromkeys(error.loop)]
            return tuple(edge for edge in loop if not edge.static)
    return path.moving if path.rival is None else (*path.moving, *path.rival.moving)

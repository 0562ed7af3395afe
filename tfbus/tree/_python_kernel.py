"""The arithmetic of a lookup along one side of a path.

One loop over Python floats, because a function call or a small array for each edge would cost more than its arithmetic.
Its formulas are those of `tfbus.geometry.rows`.
"""

import struct
from bisect import bisect_left
from math import acos, sin

from tfbus.geometry.rows import IDENTITY, Row
from tfbus.tree.history import RECORD, RECORD_SIZE, FrameHistory

_unpack = RECORD.unpack_from


_unpack_pair = struct.Struct("q7dq7d").unpack_from


Step = FrameHistory | Row


def climb(steps: tuple[Step, ...], at: int) -> Row:
    """The first step's child, seen from the last step's parent, at a stamp."""
    if not steps:
        return IDENTITY
    first = True
    for step in steps:
        if type(step) is FrameHistory:
            i = bisect_left(step.stamps, at)
            try:
                s0, ax, ay, az, ai, aj, ak, aw, s1, bx, by, bz, bi, bj, bk, bw = _unpack_pair(
                    step.records, i * RECORD_SIZE - RECORD_SIZE
                )
            except struct.error:
                # There is no pair round the first stamp, nor beyond the last.
                if not step.covers(at):
                    raise step.extrapolation_error(at) from None
                _, ax, ay, az, ai, aj, ak, aw = _unpack(step.records)
            else:
                if s0 < step.horizon and not step.covers(at):
                    raise step.extrapolation_error(at)
                if at == s1:
                    ax, ay, az, ai, aj, ak, aw = bx, by, bz, bi, bj, bk, bw
                elif step.parents is None or step.origins[i - 1][0] == step.origins[i][0]:
                    f = (at - s0) / (s1 - s0)
                    ax += f * (bx - ax)
                    ay += f * (by - ay)
                    az += f * (bz - az)
                    dot = ai * bi + aj * bj + ak * bk + aw * bw
                    if -1.0 < dot < 1.0:
                        angle = acos(dot if dot > 0.0 else -dot)
                        scale = 1.0 / sin(angle)
                        keep = sin(angle - f * angle) * scale
                        turn = sin(f * angle) * scale
                    else:
                        keep = 1.0 - f
                        turn = f
                    if dot < 0.0:
                        turn = -turn
                    ai = keep * ai + turn * bi
                    aj = keep * aj + turn * bj
                    ak = keep * ak + turn * bk
                    aw = keep * aw + turn * bw
        else:
            ax, ay, az, ai, aj, ak, aw = step
        if first:
            x, y, z, qx, qy, qz, qw = ax, ay, az, ai, aj, ak, aw
            first = False
        else:
            tx = 2.0 * (aj * z - ak * y)
            ty = 2.0 * (ak * x - ai * z)
            tz = 2.0 * (ai * y - aj * x)
            x += ax + aw * tx + aj * tz - ak * ty
            y += ay + aw * ty + ak * tx - ai * tz
            z += az + aw * tz + ai * ty - aj * tx
            turned_x = aw * qx + ai * qw + aj * qz - ak * qy
            turned_y = aw * qy - ai * qz + aj * qw + ak * qx
            turned_z = aw * qz + ai * qy - aj * qx + ak * qw
            qw = aw * qw - ai * qx - aj * qy - ak * qz
            qx = turned_x
            qy = turned_y
            qz = turned_z
    return x, y, z, qx, qy, qz, qw

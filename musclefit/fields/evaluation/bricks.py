"""Fused, threaded sums of quadratic B-splines on lattices kept in bricks: values between 0 and 1, and proved ranges.

A lattice of nodes is cut into bricks of ``SIDE`` cells along each axis, a cell being what is nearer to one node than to
any other along every axis. ``bricks`` holds a row of values for each brick, or ``NOTHING`` (all values 0) or ``WHOLE``
(all values 1). A row has the values of the brick's own nodes and of one more on each side, so that every sum stays in
one brick. They are whole numbers from 0 to ``ONE``, which stands for 1: a sum is exactly 1 where every value that it
sees is.
"""

from __future__ import annotations

import numpy as np

from musclefit.compiling import njit, threaded

SIDE = 8
"""Cells of a brick along each axis."""

ACROSS = SIDE + 2
"""Values of a brick along each axis."""

ONE = 65535
"""What stands for 1."""

NOTHING, WHOLE = -1, -2
"""Bricks without values."""

DIRECT = 12
"""Nodes along each axis over which a box is bounded one by one; wider boxes take whole bricks."""

PIECES = 18
"""Cells that a box reaches into in which the sum is bounded as the polynomial that it is."""

ROUNDING = 1e-8
"""Of a slope's coefficients, 27 products of values up to ``ONE``."""

BLOCK = 256


@njit(inline="always")
def _spline(t, w, d):
    """Values and derivatives (per cell) of three quadratic B-splines at t in [-1/2, 1/2] from the middle one's node."""
    w[0], w[1], w[2] = 0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t)
    d[0], d[1], d[2] = t - 0.5, -2.0 * t, t + 0.5


@njit(cache=True)
def _sum_at(low, h, bricks, values, x, y, z, w, d):
    """The sum at one place and its gradient, per mm."""
    i, j, k = (x - low[0]) / h, (y - low[1]) / h, (z - low[2]) / h
    if not (
        -0.5 <= i < bricks.shape[0] * SIDE - 0.5
        and -0.5 <= j < bricks.shape[1] * SIDE - 0.5
        and -0.5 <= k < bricks.shape[2] * SIDE - 0.5
    ):
        return 0.0, 0.0, 0.0, 0.0
    a, b, c = int(np.floor(i + 0.5)), int(np.floor(j + 0.5)), int(np.floor(k + 0.5))
    row = bricks[a // SIDE, b // SIDE, c // SIDE]
    if row == -1:
        return 0.0, 0.0, 0.0, 0.0
    if row == -2:
        return 1.0, 0.0, 0.0, 0.0
    _spline(i - a, w[0], d[0])
    _spline(j - b, w[1], d[1])
    _spline(k - c, w[2], d[2])
    a, b, c = a % SIDE, b % SIDE, c % SIDE
    least, most = 65535, 0
    total, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
    for p in range(3):
        for q in range(3):
            start = ((a + p) * ACROSS + b + q) * ACROSS + c
            v0, v1, v2 = values[row, start], values[row, start + 1], values[row, start + 2]
            least = min(least, v0, v1, v2)
            most = max(most, v0, v1, v2)
            along = w[2, 0] * v0 + w[2, 1] * v1 + w[2, 2] * v2
            total += w[0, p] * w[1, q] * along
            gx += d[0, p] * w[1, q] * along
            gy += w[0, p] * d[1, q] * along
            gz += w[0, p] * w[1, q] * (d[2, 0] * v0 + d[2, 1] * v1 + d[2, 2] * v2)
    if least == 65535:
        return 1.0, 0.0, 0.0, 0.0
    if most == 0:
        return 0.0, 0.0, 0.0, 0.0
    per = 65535.0 * h
    return min(total / 65535.0, 1.0), gx / per, gy / per, gz / per


@threaded(over="points", least=BLOCK)
def moved_values_at(begin, end, low, h, bricks, values, turn, shift, points, sums, gradients):
    """Write sums (N,) and their gradients (N, 3), per mm, at points (N, 3) that stand for turn x + shift.

    ``turn`` (3, 3) and ``shift`` (3,) take a point to the lattice's frame; gradients are by the point as given.
    """
    w, d = np.zeros((3, 3)), np.zeros((3, 3))
    for p in range(begin, end):
        a, b, c = points[p, 0], points[p, 1], points[p, 2]
        x = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c + shift[0]
        y = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c + shift[1]
        z = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c + shift[2]
        found, gx, gy, gz = _sum_at(low, h, bricks, values, x, y, z, w, d)
        sums[p] = found
        gradients[p, 0] = gx * turn[0, 0] + gy * turn[1, 0] + gz * turn[2, 0]
        gradients[p, 1] = gx * turn[0, 1] + gy * turn[1, 1] + gz * turn[2, 1]
        gradients[p, 2] = gx * turn[0, 2] + gy * turn[1, 2] + gz * turn[2, 2]


@threaded(over="places")
def with_borders(begin, end, bricks, places, inner, values):
    """Write rows (R, 1000) from the values (R, 8, 8, 8) of every brick's own nodes and those of the bricks around.

    ``places`` (R, 3) says which brick a row belongs to. A node has one value, whichever brick it is seen from: only so
    the sum is continuous from brick to brick.
    """
    for row in range(begin, end):
        for i in range(ACROSS):
            for j in range(ACROSS):
                for k in range(ACROSS):
                    a = places[row, 0] * SIDE + i - 1
                    b = places[row, 1] * SIDE + j - 1
                    c = places[row, 2] * SIDE + k - 1
                    value = 0
                    if (
                        0 <= a < bricks.shape[0] * SIDE
                        and 0 <= b < bricks.shape[1] * SIDE
                        and 0 <= c < bricks.shape[2] * SIDE
                    ):
                        there = bricks[a // SIDE, b // SIDE, c // SIDE]
                        if there == -2:
                            value = 65535
                        elif there >= 0:
                            value = np.int64(inner[there, a % SIDE, b % SIDE, c % SIDE])
                    values[row, (i * ACROSS + j) * ACROSS + k] = value


@threaded(over="values")
def brick_ranges(begin, end, values, out):
    """For each brick (R, 1000) write (R, 5): lowest and highest value, and largest difference along each axis."""
    for row in range(begin, end):
        least, most, x, y, z = 65535, 0, 0, 0, 0
        for i in range(ACROSS):
            for j in range(ACROSS):
                for k in range(ACROSS):
                    at = (i * ACROSS + j) * ACROSS + k
                    v = np.int64(values[row, at])
                    least, most = min(least, v), max(most, v)
                    if i:
                        x = max(x, abs(v - np.int64(values[row, at - ACROSS * ACROSS])))
                    if j:
                        y = max(y, abs(v - np.int64(values[row, at - ACROSS])))
                    if k:
                        z = max(z, abs(v - np.int64(values[row, at - 1])))
        out[row, 0], out[row, 1], out[row, 2], out[row, 3], out[row, 4] = least, most, x, y, z


@njit(cache=True)
def _nodes_seen(low, h, size, centre, half, span, first, last):
    """Write where a box begins and ends (3, 2), in nodes, and the first and last node (3,) that it sees.

    Gives the nodes along its longest side, 0 beside the lattice.
    """
    wide, beside = 0, False
    for axis in range(3):
        slack = 1e-12 * (abs(centre[axis]) + abs(low[axis]) + half[axis]) / h + 1e-12
        u = (centre[axis] - half[axis] - low[axis]) / h - slack
        v = (centre[axis] + half[axis] - low[axis]) / h + slack
        nodes = size[axis] * SIDE
        if not (v >= -0.5 and u <= nodes - 0.5):
            beside = True
        u, v = min(max(u, -2.0), nodes + 2.0), min(max(v, -2.0), nodes + 2.0)
        span[axis, 0], span[axis, 1] = u, v
        first[axis], last[axis] = int(np.floor(u + 0.5)) - 1, int(np.floor(v + 0.5)) + 1
        wide = max(wide, last[axis] - first[axis] + 1)
    return 0 if beside and np.isfinite(centre.sum() + half.sum()) else wide


@njit(cache=True)
def _gathered(bricks, values, first, last, here):
    """Write the values of nodes from the first to the last (3,) into (DIRECT, DIRECT, DIRECT); 0 beside the lattice."""
    for i in range(first[0], last[0] + 1):
        for j in range(first[1], last[1] + 1):
            to = here[i - first[0], j - first[1]]
            within = 0 <= i < bricks.shape[0] * SIDE and 0 <= j < bricks.shape[1] * SIDE
            k = first[2]
            while k <= last[2]:
                end = min(last[2] + 1, k - k % SIDE + SIDE)  # of this brick
                value, row = 0, -1
                if within and 0 <= k < bricks.shape[2] * SIDE:
                    row = bricks[i // SIDE, j // SIDE, k // SIDE]
                    if row == -2:
                        value = 65535
                if row < 0:
                    for at in range(k, end):
                        to[at - first[2]] = value
                else:
                    start = ((i % SIDE + 1) * ACROSS + j % SIDE + 1) * ACROSS + k % SIDE + 1
                    for at in range(k, end):
                        to[at - first[2]] = values[row, start + at - k]
                k = end


@njit(inline="always")
def _bernstein(u, v, cell, m, d):
    """What turns a cell's three values into Bernstein coefficients on its part from u to v, of values and slopes.

    Quadratic B-splines by their polar form, (3, 3), and their derivatives per cell, linear, at both ends (2, 3).
    """
    s, t = max(u - cell + 0.5, 0.0), min(v - cell + 0.5, 1.0)
    m[0, 0], m[0, 2] = 0.5 * (1.0 - s) * (1.0 - s), 0.5 * s * s
    m[1, 0], m[1, 2] = 0.5 * (1.0 - s) * (1.0 - t), 0.5 * s * t
    m[2, 0], m[2, 2] = 0.5 * (1.0 - t) * (1.0 - t), 0.5 * t * t
    for k in range(3):
        m[k, 1] = 1.0 - m[k, 0] - m[k, 2]
    d[0, 0], d[0, 1], d[0, 2] = s - 1.0, 1.0 - 2.0 * s, s
    d[1, 0], d[1, 1], d[1, 2] = t - 1.0, 1.0 - 2.0 * t, t


@njit(inline="always")
def _combined(x, y, z, i, j, k, here, a, b, c):
    """One Bernstein coefficient: rows i, j, k of (·, 3) matrices x, y, z on the values around a cell."""
    total = 0.0
    for p in range(3):
        for q in range(3):
            along = z[k, 0] * here[a + p, b + q, c] + z[k, 1] * here[a + p, b + q, c + 1]
            total += x[i, p] * y[j, q] * (along + z[k, 2] * here[a + p, b + q, c + 2])
    return total


@njit(cache=True)
def _range(axis, here, first, last, span, m, d):
    """Lowest and highest slope along an axis, per cell, over a box; those of the sum itself for the axis -1.

    By the Bernstein coefficients of each cell that the box reaches into, fewer by one along the axis of a slope.
    """
    least, most = np.inf, -np.inf
    x, y, z = d[0] if axis == 0 else m[0], d[1] if axis == 1 else m[1], d[2] if axis == 2 else m[2]
    for a in range(first[0] + 1, last[0]):
        _bernstein(span[0, 0], span[0, 1], a, m[0], d[0])
        for b in range(first[1] + 1, last[1]):
            _bernstein(span[1, 0], span[1, 1], b, m[1], d[1])
            for c in range(first[2] + 1, last[2]):
                _bernstein(span[2, 0], span[2, 1], c, m[2], d[2])
                at = (a - 1 - first[0], b - 1 - first[1], c - 1 - first[2])
                for i in range(len(x)):
                    for j in range(len(y)):
                        for k in range(len(z)):
                            value = _combined(x, y, z, i, j, k, here, at[0], at[1], at[2])
                            least, most = min(least, value), max(most, value)
    return least, most


@njit(inline="always")
def _pieces(first, last):
    """How many cells a box reaches into."""
    return (last[0] - first[0] - 1) * (last[1] - first[1] - 1) * (last[2] - first[2] - 1)


@njit(cache=True)
def _over_bricks(bricks, ranges, first, last, highs):
    """Lowest and highest value of the bricks that nodes lie in; write the largest differences (3,)."""
    least, most = np.int64(65535), np.int64(0)
    highs[:] = 0.0
    for a in range(max(first[0], 0) // SIDE, min(last[0] // SIDE, bricks.shape[0] - 1) + 1):
        for b in range(max(first[1], 0) // SIDE, min(last[1] // SIDE, bricks.shape[1] - 1) + 1):
            for c in range(max(first[2], 0) // SIDE, min(last[2] // SIDE, bricks.shape[2] - 1) + 1):
                row = bricks[a, b, c]
                if row == -1:
                    least = np.int64(0)
                elif row == -2:
                    most = np.int64(65535)
                else:
                    least, most = min(least, ranges[row, 0]), max(most, ranges[row, 1])
                    for axis in range(3):
                        highs[axis] = max(highs[axis], 1.0 * ranges[row, 2 + axis])
    for axis in range(3):
        if first[axis] < 0 or last[axis] >= bricks.shape[axis] * SIDE:
            least = np.int64(0)
    return least, most


@threaded(over="centres", least=64)
def value_ranges(begin, end, low, h, bricks, values, ranges, centres, half_widths, out):
    """Write the proved lowest and highest sum (B, 2) over boxes of centres and half widths (B, 3), mm.

    Boxes are in the lattice's own frame; ``ranges`` is what `brick_ranges` gives.
    """
    first, last, highs = np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3)
    here = np.zeros((DIRECT, DIRECT, DIRECT), np.int32)
    span, splines, slopes = np.zeros((3, 2)), np.zeros((3, 3, 3)), np.zeros((3, 2, 3))
    for box in range(begin, end):
        wide = _nodes_seen(low, h, bricks.shape, centres[box], half_widths[box], span, first, last)
        if wide == 0:
            out[box, 0] = out[box, 1] = 0.0
            continue
        least, most = _over_bricks(bricks, ranges, first, last, highs)
        if wide <= DIRECT and least < most:
            _gathered(bricks, values, first, last, here)
            least, most = np.int64(65535), np.int64(0)
            for i in range(last[0] - first[0] + 1):
                for j in range(last[1] - first[1] + 1):
                    for k in range(last[2] - first[2] + 1):
                        v = here[i, j, k]
                        least, most = min(least, v), max(most, v)
        out[box, 0], out[box, 1] = least / 65535.0, most / 65535.0
        if wide <= DIRECT and least < most and _pieces(first, last) <= PIECES:
            lowest, highest = _range(-1, here, first, last, span, splines, slopes)
            out[box, 0] = max(out[box, 0], lowest / 65535.0 - 1e-13)
            out[box, 1] = min(out[box, 1], highest / 65535.0 + 1e-13)


@njit(cache=True)
def _differences(here, m, lows, highs):
    """Write the extreme differences (3,) along each axis of m (3,) nodes; the sum of the squared second ones, at most.

    Each entry of the second derivatives is a mean of the second differences of its kind.
    """
    lows[:], highs[:] = 1e9, -1e9
    xx, yy, zz, xy, xz, yz = 0, 0, 0, 0, 0, 0
    for i in range(m[0]):
        for j in range(m[1]):
            for k in range(m[2]):
                v = here[i, j, k]
                x, y, z = 0, 0, 0
                if i < m[0] - 1:
                    x = here[i + 1, j, k] - v
                    lows[0], highs[0] = min(lows[0], x), max(highs[0], x)
                if j < m[1] - 1:
                    y = here[i, j + 1, k] - v
                    lows[1], highs[1] = min(lows[1], y), max(highs[1], y)
                if k < m[2] - 1:
                    z = here[i, j, k + 1] - v
                    lows[2], highs[2] = min(lows[2], z), max(highs[2], z)
                if i < m[0] - 2:
                    xx = max(xx, abs(here[i + 2, j, k] - here[i + 1, j, k] - x))
                if j < m[1] - 2:
                    yy = max(yy, abs(here[i, j + 2, k] - here[i, j + 1, k] - y))
                if k < m[2] - 2:
                    zz = max(zz, abs(here[i, j, k + 2] - here[i, j, k + 1] - z))
                if i < m[0] - 1 and j < m[1] - 1:
                    xy = max(xy, abs(here[i + 1, j + 1, k] - here[i, j + 1, k] - x))
                if i < m[0] - 1 and k < m[2] - 1:
                    xz = max(xz, abs(here[i + 1, j, k + 1] - here[i, j, k + 1] - x))
                if j < m[1] - 1 and k < m[2] - 1:
                    yz = max(yz, abs(here[i, j + 1, k + 1] - here[i, j, k + 1] - y))
    return 1.0 * xx * xx + 1.0 * yy * yy + 1.0 * zz * zz + 2.0 * (1.0 * xy * xy + 1.0 * xz * xz + 1.0 * yz * yz)


@threaded(over="centres", least=64)
def slope_ranges(begin, end, low, h, bricks, values, ranges, centres, half_widths, gradients, out):
    """Write proved (B, 2) over boxes as `value_ranges`: the longest gradient, and how far it gets from the centre's.

    ``gradients`` (B, 3) are those at the centres, per mm as what is written.
    """
    top = 1.0 + 1e-12
    first, last = np.zeros(3, np.int64), np.zeros(3, np.int64)
    m, lows, highs = np.zeros(3, np.int64), np.zeros(3), np.zeros(3)
    here = np.zeros((DIRECT, DIRECT, DIRECT), np.int32)
    span, splines, slopes = np.zeros((3, 2)), np.zeros((3, 3, 3)), np.zeros((3, 2, 3))
    for box in range(begin, end):
        wide = _nodes_seen(low, h, bricks.shape, centres[box], half_widths[box], span, first, last)
        if wide == 0:
            out[box, 0] = out[box, 1] = 0.0
            continue
        bend = np.inf
        if wide <= DIRECT:
            _gathered(bricks, values, first, last, here)
            for axis in range(3):
                m[axis] = last[axis] - first[axis] + 1
            squares = _differences(here, m, lows, highs)
            reach = np.sqrt((half_widths[box] ** 2).sum())
            bend = np.sqrt(squares) / (65535.0 * h * h) * reach
            if squares > 0.0 and _pieces(first, last) <= PIECES:
                for axis in range(3):
                    least, most = _range(axis, here, first, last, span, splines, slopes)
                    lows[axis], highs[axis] = least - ROUNDING, most + ROUNDING
        else:
            _over_bricks(bricks, ranges, first, last, highs)
            for axis in range(3):
                lows[axis] = -highs[axis]
        steepest, off = 0.0, 0.0
        for axis in range(3):
            a, b = lows[axis] / (65535.0 * h), highs[axis] / (65535.0 * h)
            steepest += max(a * a, b * b)
            more = max(b - gradients[box, axis], gradients[box, axis] - a)
            off += more * more
        out[box, 0] = np.sqrt(steepest) * top
        out[box, 1] = min(np.sqrt(off), bend) * top + 1e-13 / h

"""Curves over time, or whatever rises, as SVG for a page: takes numbers and names, gives text; measures nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

WIDTH, HEIGHT = 560, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 12, 14, 40
TONES = ("#7a2e2e", "#1f6f8b", "#b8860b", "#3d7a3d", "#6b3fa0", "#c2571a")
"""Of the curves that are named."""


def curves(
    times: Sequence[float],
    lines: Mapping[str, Sequence[float | None]],
    *,
    unit: str,
    along: str = "time, s",
    named: int = len(TONES),
) -> str:
    """One SVG of lines over time; the ``named`` ones that change most are coloured and named, the others grey.

    Parameters
    ----------
    times : sequence of float
        Rising.
    lines : mapping of name to values
        None where there is no value: the line is broken there.
    unit : str
        Of the values.
    along : str
        What rises, with its unit.
    named : int
    """
    known = [v for line in lines.values() for v in line if v is not None and math.isfinite(v)]
    if not known or len(times) < 2:
        return ""
    low, high = _padded(min(known), max(known))
    ranked = sorted(lines, key=lambda name: -_spread(lines[name]))
    tones = dict(zip(ranked, TONES[:named], strict=False))

    def x(time: float) -> float:
        return _LEFT + (WIDTH - _LEFT - _RIGHT) * (time - times[0]) / (times[-1] - times[0])

    def y(value: float) -> float:
        return HEIGHT - _BOTTOM - (HEIGHT - _TOP - _BOTTOM) * (value - low) / (high - low)

    parts = [f'<svg class="curves" viewBox="0 0 {WIDTH} {HEIGHT + 16 * len(tones)}" role="img">']
    for value in _ticks(low, high):
        at = f"{y(value):.1f}"
        parts.append(f'<line x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{at}" y2="{at}" class="grid"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{_said(value)}</text>')
    parts += [
        f'<text x="{x(time):.1f}" y="{HEIGHT - _BOTTOM + 16}" text-anchor="middle">{_said(time)}</text>'
        for time in _ticks(times[0], times[-1])
    ]
    parts.append(f'<text x="{(WIDTH + _LEFT) / 2:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(along)}</text>')
    middle = (HEIGHT - _BOTTOM + _TOP) / 2
    turned = f'transform="rotate(-90 14 {middle:.0f})" text-anchor="middle"'
    parts.append(f'<text x="14" y="{middle:.0f}" {turned}>{escape(unit)}</text>')
    for name in sorted(lines, key=lambda name: name in tones):
        path = _path([x(time) for time in times], [None if v is None else y(v) for v in lines[name]])
        tone, width = (tones[name], 2.0) if name in tones else ("#c4cbd0", 1.0)
        parts.append(
            f'<path d="{path}" fill="none" stroke="{tone}" stroke-width="{width}"><title>{escape(name)}</title></path>'
        )
    for row, (name, tone) in enumerate(tones.items()):
        below = HEIGHT + 16 * row + 6
        parts.append(f'<rect x="{_LEFT}" y="{below - 4}" width="18" height="3" fill="{tone}"/>')
        parts.append(f'<text x="{_LEFT + 24}" y="{below + 1}">{escape(name)}</text>')
    parts.append("</svg>")
    return "\n".join(parts)


def _path(xs: Sequence[float], ys: Sequence[float | None]) -> str:
    words, pen = [], "M"
    for x, y in zip(xs, ys, strict=True):
        if y is None or not math.isfinite(y):
            pen = "M"
            continue
        words.append(f"{pen}{x:.1f} {y:.1f}")
        pen = "L"
    return " ".join(words)


def _spread(line: Sequence[float | None]) -> float:
    known = [v for v in line if v is not None and math.isfinite(v)]
    return max(known) - min(known) if known else 0.0


def _padded(low: float, high: float) -> tuple[float, float]:
    room = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - room, high + room


def _ticks(low: float, high: float) -> list[float]:
    """Round values between, about five."""
    rough = (high - low) / 5.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= rough)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _said(value: float) -> str:
    return f"{0.0 if abs(value) < 1e-12 else value:.6g}".replace("-", "\N{MINUS SIGN}")

"""Marker trajectories (OpenSim's .trc): text <-> names and positions in mm over all frames; knows no landmark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Float, Points
from musclefit.io.formats.texts import in_mm
from musclefit.vocabulary import Unit

UNITS = {
    **{unit.value: unit for unit in Unit},
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), Unit.MILLIMETRE),
    **dict.fromkeys(("centimeter", "centimeters", "centimetre", "centimetres"), Unit.CENTIMETRE),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), Unit.METRE),
}
"""What files call units, in small letters."""

_FIRST_MARKER = 2
"""Columns before the first marker: frame and time."""


@dataclass(frozen=True, eq=False, slots=True)
class Trajectories:
    """One file of markers.

    Parameters
    ----------
    names : tuple of str, length m
    positions : (frames, m, 3) float64, mm
        Not a number where a marker was not seen: its cells are empty, no numbers, or 0 0 0.
    unit : Unit
        Of the file.
    lines : tuple of str
        The file's lines; those of frames are ``frame_lines``.
    frame_lines : tuple of int
    lost : tuple of int, length m
        In how many frames each marker is written 0 0 0.
    """

    names: tuple[str, ...]
    positions: Float
    unit: Unit
    lines: tuple[str, ...]
    frame_lines: tuple[int, ...]
    lost: tuple[int, ...]

    def mean(self) -> Points:
        """(m, 3) mean over the frames in which each marker was seen, mm."""
        means: Points = np.nanmean(self.positions, axis=0)
        return means

    def largest_motion(self) -> tuple[str, float]:
        """The marker that is farthest from its mean in some frame, and how far, mm."""
        off = np.nanmax(np.linalg.norm(self.positions - self.mean(), axis=2), axis=0)
        worst = int(np.argmax(off))
        return self.names[worst], float(off[worst])

    @property
    def seen(self) -> Points:
        """(k, 3) all positions that were seen, frame by frame, mm."""
        flat = self.positions.reshape(-1, 3)
        found: Points = flat[np.isfinite(flat).all(axis=1)]
        return found

    def times_s(self, source: str) -> Float:
        """(frames,) the column Time, s.

        Raises
        ------
        LandmarkError
            A time that is no finite number, or that does not rise.
        """
        times = np.empty(len(self.frame_lines))
        for k, line in enumerate(self.frame_lines):
            cells = _cells(self.lines[line])
            try:
                times[k] = float(cells[1])
            except (IndexError, ValueError):
                times[k] = np.nan
            if not np.isfinite(times[k]) or (k and not times[k] > times[k - 1]):
                found = cells[1] if len(cells) > 1 else "nothing"
                raise LandmarkError(
                    f"{source}: line {line + 1}: Time is {found}; expected numbers that rise, correct it"
                )
        return times

    def with_seen(self, moved: Points) -> str:
        """The file's text with the positions that were seen, (k, 3) mm, moved."""
        flat = np.array(self.positions.reshape(-1, 3))
        flat[np.isfinite(flat).all(axis=1)] = moved
        frames = flat.reshape(self.positions.shape) / self.unit.in_mm
        lines = list(self.lines)
        for line, frame in zip(self.frame_lines, frames, strict=True):
            cells = _cells(lines[line])
            head, before = cells[:_FIRST_MARKER], [*cells[_FIRST_MARKER:], *[""] * frame.size]
            moved_cells = (
                old if np.isnan(x) else repr(float(x)) for x, old in zip(frame.ravel(), before, strict=False)
            )
            lines[line] = "\t".join([*head, *moved_cells])
        return "\n".join(lines) + "\n"


def read_trajectories(text: str, source: str, *, units: Unit) -> Trajectories:
    """Read the text of a .trc file.

    Parameters
    ----------
    text : str
    source : str
        The file, for messages.
    units : Unit
        Where the file states none.

    Raises
    ------
    LandmarkError
        A header that is not that of a .trc file, fewer or more frames or markers than it states, a value that is no
        number, or a marker that no frame has.
    """
    lines = tuple(text.splitlines())
    stated = _stated(lines, source)
    unit = _unit(stated.get("Units", ""), source, units)
    names = tuple(cell for cell in _cells(lines[3])[_FIRST_MARKER:] if cell)
    n_markers, n_frames = (_count(stated, key, source) for key in ("NumMarkers", "NumFrames"))
    if len(names) != n_markers:
        raise LandmarkError(f"{source}: names {len(names)} markers, but its header says {n_markers}; export it again")
    rows = tuple(i for i in range(5, len(lines)) if lines[i].strip())
    if len(rows) != n_frames:
        raise LandmarkError(
            f"{source}: has {len(rows)} frames, but its header says {n_frames}; the file is cut short, export it again"
        )
    if not rows:
        raise LandmarkError(f"{source}: has no frame; export it again")
    positions = np.stack([_frame(lines[i], i + 1, source, n_markers) for i in rows])
    positions = in_mm(positions, unit, source=source, error=LandmarkError)
    lost = (positions == 0.0).all(axis=2)
    positions[lost] = np.nan
    never = np.flatnonzero(~np.isfinite(positions).all(axis=2).any(axis=0))
    if never.size:
        zeros = ", which is how lost markers are written" if lost[:, never[0]].any() else ""
        at = " but at 0 0 0" if zeros else ""
        raise LandmarkError(f"{source}: marker {names[never[0]]!r} is in no frame{at}{zeros}; leave its columns out")
    return Trajectories(names, positions, unit, lines, rows, tuple(int(k) for k in lost.sum(axis=0)))


def _cells(line: str) -> list[str]:
    """The cells of a line: parted by tabs, or by blanks where it has no tab; empty ones cannot be told then."""
    return [cell.strip() for cell in line.split("\t")] if "\t" in line else line.split()


def _stated(lines: tuple[str, ...], source: str) -> dict[str, str]:
    if len(lines) < 5 or not lines[0].startswith("PathFileType") or not lines[3].startswith("Frame#"):
        raise LandmarkError(
            f"{source}: no .trc file: it needs a first line PathFileType, two lines with NumFrames, NumMarkers and "
            "Units, and a fourth line Frame#, Time and the markers; export it again"
        )
    return dict(zip(_cells(lines[1]), _cells(lines[2]), strict=False))


def _unit(said: str, source: str, units: Unit) -> Unit:
    if not said.strip():
        return units
    if said.strip().lower() not in UNITS:
        raise LandmarkError(f"{source}: Units is {said.strip()!r}; known are {', '.join(Unit)}")
    return UNITS[said.strip().lower()]


def _count(stated: dict[str, str], key: str, source: str) -> int:
    try:
        return int(stated[key])
    except (KeyError, ValueError):
        raise LandmarkError(
            f"{source}: {key} is {stated.get(key, 'missing')}, no whole number; export it again"
        ) from None


def _frame(line: str, number: int, source: str, n_markers: int) -> Points:
    """(m, 3) positions of one frame in the file's unit; a marker with an empty value is not a number."""
    cells = _cells(line)[_FIRST_MARKER:]
    wanted = 3 * n_markers
    if "\t" not in line and len(cells) < wanted:
        raise LandmarkError(
            f"{source}: line {number} has {len(cells)} coordinates, not {wanted}, and blanks part them: which marker "
            "is missing cannot be told; export it with tabs"
        )
    if len(cells) > wanted and any(cells[wanted:]):
        raise LandmarkError(f"{source}: line {number} has {len(cells)} coordinates, not {wanted}; correct it")
    cells = (cells + [""] * wanted)[:wanted]
    values = np.empty(wanted)
    for k, cell in enumerate(cells):
        try:
            values[k] = float(cell) if cell else np.nan
        except ValueError:
            raise LandmarkError(f"{source}: line {number}: {cell!r} is not a number; correct it") from None
    found = values.reshape(-1, 3)
    found[~np.isfinite(found).all(axis=1)] = np.nan
    return found

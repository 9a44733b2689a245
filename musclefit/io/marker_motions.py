"""Markers (.trc, .c3d) on an OpenSim model -> the model's coordinates over time, by OpenSim's inverse kinematics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.findings import Finding, some_of
from musclefit.errors import InputError
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.io.formats.c3d import read_c3d
from musclefit.io.formats.opensim_motion import CoordinateMotion, range_findings
from musclefit.io.formats.osim import OpenSimModel
from musclefit.io.formats.texts import decoded
from musclefit.io.formats.trc import read_trajectories
from musclefit.io.libraries.process import asked
from musclefit.rig.marker_fits import MarkerResiduals, marker_places, open_coordinates
from musclefit.rig.multibody import Coordinate, Multibody
from musclefit.rig.table_reader import suggestion
from musclefit.vocabulary import Unit

ENDINGS = (".trc", ".c3d")

ACCURACY = 1e-9
"""Of OpenSim's solver; recovers coordinates of exact markers within 1e-6 degrees."""

WORST_RMS_MM = 100.0
"""Markers farther off than this, rms, are in another frame or unit, or on another model."""

_AT_END = 1e-3
"""Radians or metres from an end of a range that count as standing there."""

TURNED_DEG = 60.0
"""A body on the ground turned farther than this in every frame is said to lie turned."""


class Up(StrEnum):
    """The axis of a recording that points up; OpenSim's ground has y."""

    X = "x"
    Y = "y"
    Z = "z"


_TO_Y_UP: Mapping[Up, Float] = {
    Up.X: np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    Up.Y: np.eye(3),
    Up.Z: np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}


@dataclass(frozen=True, slots=True)
class MarkerFrame:
    """How a recording stands in the model's ground: ``up`` is turned to y first, then ``shift_mm`` is added.

    ``up`` is None where it was not said: y for a .trc, and nothing for a .c3d.
    """

    up: Up | None = None
    shift_mm: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """Markers over time, in the ground's frame: names, (f,) s, (f, m, 3) mm, not a number where one was not seen."""

    names: tuple[str, ...]
    times_s: Float
    positions: Float


def read_recording(data: bytes, *, source: str, frame: MarkerFrame) -> Recording:
    """Read a .trc or .c3d file into the ground's frame.

    Raises
    ------
    InputError
        What `read_trajectories` or `read_c3d` refuse, a .c3d whose axis up was not said, or two markers of one name.
    """
    if source.lower().endswith(".c3d"):
        if frame.up is None:
            raise InputError(
                f"{source}: a .c3d does not say which axis points up, and laboratories differ; set drive.markers_up to "
                'x, y or z (most often "z")'
            )
        names, times, positions = read_c3d(data, source=source)
    else:
        read = read_trajectories(decoded(data, source), source, units=Unit.MILLIMETRE)
        names, times, positions = read.names, read.times_s(source), read.positions
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{source}: two markers are named {name!r}; rename or remove one")
    turn = _TO_Y_UP[frame.up or Up.Y]
    return Recording(tuple(names), times, positions @ turn.T + np.array(frame.shift_mm))


def coordinates_of_markers(
    data: bytes, model: OpenSimModel, *, source: str, frame: MarkerFrame | None = None
) -> CoordinateMotion:
    """The coordinates whose poses bring the model's markers nearest to recorded ones, frame by frame.

    Markers are matched by name and weigh the same; the squares of their distances are summed. The times are the file's
    own. Locked coordinates stay, and clamped ones keep their ranges, as in OpenSim. Residuals are measured anew, in the
    poses that our own kinematics make of the coordinates.

    Parameters
    ----------
    data : bytes
    model : OpenSimModel
    source : str
        The file; its ending says what it is.
    frame : MarkerFrame, optional

    Raises
    ------
    InputError
        What `read_recording` refuses, no marker that the model has, a frame without any, a library that is missing or
        fails, or markers so far off that the frame must be wrong; the message then says which shift would fit.
    """
    recording = read_recording(data, source=source, frame=frame or MarkerFrame())
    on_model = {point.name: (point.body, point.at) for point in model.points if point.kind == "Marker"}
    names = [name for name in recording.names if name in on_model]
    if not names:
        there = suggestion(recording.names[0], tuple(on_model)) if on_model else "the model has none"
        raise InputError(
            f"{source}: none of its {len(recording.names)} markers is one of the model's; {there}: rename the markers "
            "in one of the two"
        )
    positions = recording.positions[:, [recording.names.index(name) for name in names]]
    seen: Bool = np.asarray(np.isfinite(positions).all(axis=2))
    unseen = np.flatnonzero(~seen.any(axis=1))
    if unseen.size:
        raise InputError(
            f"{source}: at {recording.times_s[unseen[0]]:g} s no marker of the model is seen ({unseen.size} such "
            "frames); cut them off or fill the gap"
        )
    found = _solved(model, names, recording.times_s, positions, source)
    markers = [on_model[name] for name in names]
    rows = [{name: float(column[k]) for name, column in found.items()} for k in range(len(recording.times_s))]
    placed = np.stack([marker_places(model.multibody, markers, row) for row in rows])
    residuals = MarkerResiduals(tuple(names), recording.times_s, np.linalg.norm(placed - positions, axis=2))
    if residuals.rms_mm > WORST_RMS_MM:
        raise _far_off(model, names, positions, residuals, source)
    findings = [
        *_residual_findings(residuals, source),
        *_name_findings(recording.names, names, tuple(on_model), source),
        *_gap_findings(names, seen, source),
        *_pose_findings(model.multibody, markers, rows, seen, source),
    ]
    coupled = {coupler.dependent for coupler in model.multibody.couplers}
    values = {}
    for name, of in model.multibody.coordinates.items():
        if not of.locked and name not in coupled:
            values[name] = found[name]
            findings += [*range_findings(of, found[name], source), *_end_findings(of, found[name], source)]
    return CoordinateMotion(recording.times_s, values, tuple(findings))


def _solved(
    model: OpenSimModel, names: Sequence[str], times_s: Float, positions: Float, source: str
) -> Mapping[str, Float]:
    answer = _asked("inverse_kinematics", model, names, times_s, positions, source)
    if not np.isfinite(answer["values"]).all():
        raise InputError(f"{source}: OpenSim's inverse kinematics ended at no finite value; correct the markers")
    return {str(name): answer["values"][:, k] for k, name in enumerate(answer["names"])}


def _asked(
    task: str, model: OpenSimModel, names: Sequence[str], times_s: Float, positions: Float, source: str
) -> Mapping[str, Any]:
    given = {
        "labels": np.array(names, dtype=str),
        "times": times_s,
        "positions_m": positions / Unit.METRE.in_mm,
        "accuracy": ACCURACY,
    }
    return asked(task, given, {"model.osim": model.data}, library="opensim", source=source)


def _far_off(
    model: OpenSimModel, names: Sequence[str], positions: Float, residuals: MarkerResiduals, source: str
) -> InputError:
    """The error of markers that are in another frame, with the shift that would bring those of the first frame near."""
    found = _asked("fitting_shift", model, names, residuals.times_s[:1], positions[:1], source)
    shift, left = found["shift_m"] * Unit.METRE.in_mm, float(found["rms_m"]) * Unit.METRE.in_mm
    name, largest, _ = residuals.worst
    message = (
        f"{source}: the model's markers stay {residuals.rms_mm:.0f} mm (rms) from the recorded ones, {name!r} up to "
        f"{largest:.0f} mm: they are in another frame or unit, or of another person's size"
    )
    if left < WORST_RMS_MM / 4.0:
        way = ", ".join(f"{x:.0f}" for x in shift)
        message += (
            f"; shifted by ({way}) mm those of the first frame would come within {left:.0f} mm: if that is right, set "
            f"drive.markers_shift_mm = [{way}]"
        )
    else:
        message += "; say which axis points up by drive.markers_up, correct Units, or scale the model to the person"
    return InputError(message)


def _residual_findings(residuals: MarkerResiduals, source: str) -> list[Finding]:
    subject = Path(source).name
    name, largest, at = residuals.worst
    whole = (
        f"{len(residuals.names)} markers by OpenSim's inverse kinematics, all of one weight: residual "
        f"{residuals.rms_mm:.3g} mm rms over {len(residuals.times_s)} frames, at most {largest:.3g} mm, "
        f"{name} at {at:.4g} s"
    )
    found = [Finding(subject, "marker-residuals", whole)]
    for marker in residuals.names:
        rms, most, when = residuals.of(marker)
        found.append(
            Finding(marker, "marker-residual", f"{marker}: {rms:.3g} mm rms, at most {most:.3g} mm at {when:.4g} s")
        )
    return found


def _name_findings(recorded: Sequence[str], used: Sequence[str], known: Sequence[str], source: str) -> list[Finding]:
    subject = Path(source).name
    found = []
    unused = [name for name in recorded if name not in used]
    if unused:
        message = f"{len(unused)} recorded markers are not the model's and were not used: {some_of(unused, most=60)}"
        found.append(Finding(subject, "unused-markers", message))
    missing = [name for name in known if name not in used]
    if missing:
        message = f"{len(missing)} markers of the model were not recorded: {some_of(missing, most=80)}"
        found.append(Finding(subject, "markers-not-recorded", message))
    return found


def _end_findings(of: Coordinate, values: Float, source: str) -> list[Finding]:
    """That a clamped coordinate stands at an end of its range, which may keep the markers off."""
    if not of.clamped:
        return []
    at_end = int((np.minimum(np.abs(values - of.low), np.abs(values - of.high)) < _AT_END).sum())
    if not at_end:
        return []
    message = f"{of.name} is clamped and stands at an end of its range in {at_end} of {len(values)} frames"
    return [Finding(Path(source).name, "clamped-coordinate", message)]


def _gap_findings(names: Sequence[str], seen: Bool, source: str) -> list[Finding]:
    lost = (~seen).sum(axis=0)
    if not lost.any():
        return []
    said = ", ".join(f"{name} ({k})" for name, k in zip(names, lost.tolist(), strict=True) if k)
    message = f"markers are missing in so many of {len(seen)} frames and do not count there: {said}"
    return [Finding(Path(source).name, "marker-gaps", message)]


def _pose_findings(
    multibody: Multibody,
    markers: Sequence[tuple[str, Points]],
    rows: Sequence[Mapping[str, float]],
    seen: Bool,
    source: str,
) -> list[Finding]:
    """Coordinates that the markers leave open, at rank-deficient frames, and a model that lies turned in all."""
    subject, found = Path(source).name, []
    fewest = int(seen.sum(axis=1).argmin())
    loose = open_coordinates(multibody, markers, multibody.values(rows[fewest]), seen=seen[fewest])
    if loose:
        message = (
            f"{len(loose)} coordinates are not fixed by the markers and stay near where they were: {', '.join(loose)}"
        )
        found.append(Finding(subject, "coordinates-open", message))
    rest = multibody.places({})
    roots = [joint.child for joint in multibody.joints[:1]]
    for body in roots:
        turns = [(multibody.places(row)[body] @ rest[body].inverse()).turn_deg for row in rows]
        if min(turns) > TURNED_DEG:
            message = (
                f"body {body} is turned by {min(turns):.0f} degrees or more from the default pose in every frame; if "
                "the subject does not lie or turn so, another axis points up: set drive.markers_up"
            )
            found.append(Finding(subject, "model-turned", message))
    return found

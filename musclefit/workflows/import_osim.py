"""An OpenSim model to a rig folder: bones as surfaces, muscle paths, markers and wrap objects, mm, and the rig."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.errors import InputError
from musclefit.io.drives.opensim import coordinate_motion
from musclefit.io.formats.osim import OpenSimModel, parse_osim
from musclefit.io.formats.rows import csv_of
from musclefit.io.formats.tables import toml_string
from musclefit.io.formats.texts import read_bytes
from musclefit.io.marker_motions import ENDINGS as MARKERS
from musclefit.io.marker_motions import MarkerFrame, Up
from musclefit.io.opensim_geometry import BETWEEN, PlacedMesh, find_geometry, placed_meshes
from musclefit.io.run_folder import ply_bytes, require_new_folder, write_new_folder
from musclefit.progress import Progress
from musclefit.rig.multibody import CoordinateKind
from musclefit.workflows.given import word
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown

MODEL, RIG = "model.osim", "rig.toml"


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class ImportedModel(Shown):
    """An OpenSim model that was made into a rig.

    Parameters
    ----------
    folder : Path
    model : OpenSimModel
    meshes : tuple of PlacedMesh
    missing : tuple of str
        Geometry that was nowhere.
    notes : tuple of str
        What the rig leaves out, and what was found in the motion.
    """

    folder: Path
    model: OpenSimModel
    meshes: tuple[PlacedMesh, ...]
    missing: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def open(self) -> tuple[PlacedMesh, ...]:
        """Meshes that are no closed surface, and so no part of the rig."""
        return tuple(mesh for mesh in self.meshes if mesh.fault)

    @property
    def counts(self) -> dict[str, int]:
        """How many of everything."""
        model = self.model
        return {
            "bodies": len(model.multibody.bodies),
            "joints": len(model.multibody.joints),
            "coordinates": len(model.multibody.coordinates),
            "couplers": len(model.multibody.couplers),
            "bones": len(self.meshes) - len(self.open),
            "open_meshes": len(self.open),
            "muscles": len({point.of for point in model.points if point.of}),
            "path_points": sum(1 for point in model.points if point.of),
            "markers": sum(1 for point in model.points if point.kind == "Marker"),
            "wrap_objects": len(model.wraps),
        }

    def said(self) -> str:
        """Counts in a line."""
        counts = ", ".join(f"{count} {what.replace('_', ' ')}" for what, count in self.counts.items())
        return f"{self.model.name}: {counts}; in {self.folder}"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Meshes and coordinates."""
        meshes = [{"name": m.name, "body": m.body, "file": str(m.file), "fault": m.fault} for m in self.meshes]
        return {"meshes": meshes, "coordinates": list(_coordinate_rows(self.model))}

    def to_json(self) -> dict[str, Any]:
        """All of it."""
        return {
            "folder": str(self.folder),
            "model": self.model.name,
            **self.counts,
            "open": {mesh.name: mesh.fault for mesh in self.open},
            "missing": list(self.missing),
            "notes": list(self.notes),
        }


def import_osim(
    model: str | Path,
    out: str | Path,
    *,
    motion: str | Path | None = None,
    markers_up: Up | str | None = None,
    markers_shift_mm: Sequence[float] = (),
    geometry: Sequence[str | Path] = (),
    skip_missing: bool = False,
    progress: Progress | None = None,
) -> ImportedModel:
    """Make a rig folder of an OpenSim model; its bones pose as OpenSim's own kinematics has them.

    Parameters
    ----------
    model : path
        An .osim file, versions 2.3 to 4.
    out : path
        New or empty folder: ``rig.toml``, ``model.osim``, ``bones/``, ``muscle_paths.csv``, ``markers.csv``,
        ``wraps.csv`` and ``coordinates.csv``; all lengths mm, in the ground's frame and the default pose.
    motion : path, optional
        .mot or .sto, or markers in a .trc or .c3d, that the rig follows; copied beside it.
    markers_up : {"x", "y", "z"}, optional
        The axis of the markers' file that points up; without it y, which a .c3d must say.
    markers_shift_mm : sequence of 3 float
        Added to the markers then, mm.
    geometry : sequence of path
        Further folders to look for meshes in, after the model's own and its Geometry.
    skip_missing : bool
        Whether to go on without meshes that are not found.
    progress : Progress, optional

    Returns
    -------
    ImportedModel
        The model, its meshes, which of them are missing, and what the rig leaves out.

    Raises
    ------
    InputError, MeshError
        A model or motion that cannot be read, geometry that is missing, or a folder that is not empty.
    """
    source, folder = Path(model), Path(out)
    require_new_folder(folder)
    frame = _marker_frame(motion, markers_up, markers_shift_mm)
    with watched(progress) as stages:
        with stages.stage("read the model"):
            read = read_osim(source)
        notes = list(read.not_followed)
        motion_bytes = None
        if motion is not None:
            motion_bytes = read_bytes(Path(motion))
            with stages.stage("read the motion"):
                found = coordinate_motion(motion_bytes, read, source=str(motion), frame=frame).findings
            notes += [finding.message for finding in found]
        files, missing = find_geometry(read, [Path(place) for place in geometry])
        if missing and not skip_missing:
            raise InputError(
                f"{source}: {len(missing)} meshes are neither beside the model nor in its Geometry folder: "
                f"{', '.join(missing[:6])}{', ...' if len(missing) > 6 else ''}; name their folder with --geometry, or "
                "go on without them by --skip-missing"
            )
        with stages.stage("read and place the meshes"):
            meshes = placed_meshes(read, files)
        if not any(not mesh.fault for mesh in meshes):
            raise InputError(
                f"{source}: no mesh of the model is a closed surface, so there is no bone to drive"
                + (f" (the first: {meshes[0].fault})" if meshes else "")
                + "; mend them with `musclefit repair`, or attach closed ones"
            )
        called = Path(motion).name if motion is not None else ""
        texts = {
            RIG: rig_text(read, meshes, motion=called, frame=frame),
            "muscle_paths.csv": _pointscsv_of(read, muscles=True),
            "markers.csv": _pointscsv_of(read, muscles=False),
            "wraps.csv": _wrapscsv_of(read),
            "coordinates.csv": csv_of(list(_coordinate_rows(read))),
        }
        contents = {name: text.encode() for name, text in texts.items() if text} | {MODEL: read.data}
        if motion_bytes is not None:
            contents[called] = motion_bytes
        for mesh in meshes:
            contents[f"{'open' if mesh.fault else 'bones'}/{mesh.name}.ply"] = ply_bytes(mesh.mesh)
        write_new_folder(folder, contents)
    return ImportedModel(folder, read, meshes, tuple(missing), tuple(notes))


def _marker_frame(motion: str | Path | None, up: Up | str | None, shift_mm: Sequence[float]) -> MarkerFrame:
    if (up or shift_mm) and (motion is None or Path(motion).suffix.lower() not in MARKERS):
        raise InputError("markers_up and markers_shift_mm have no effect without a .trc or .c3d; leave them out")
    if shift_mm and (len(shift_mm) != 3 or not np.isfinite(shift_mm).all()):
        raise InputError(f"markers_shift_mm: found {list(shift_mm)}; expected x, y and z, finite, mm")
    said = None if up is None else word(Up, up, what="markers_up")
    return MarkerFrame(said, tuple(float(x) for x in shift_mm) or (0.0, 0.0, 0.0))


def read_osim(path: Path) -> OpenSimModel:
    """Read a model file.

    Raises
    ------
    InputError
        It cannot be read, or what `parse_osim` refuses.
    """
    return parse_osim(read_bytes(path), source=str(path))


def rig_text(
    model: OpenSimModel, meshes: Sequence[PlacedMesh], *, motion: str = "", frame: MarkerFrame | None = None
) -> str:
    """The rig of a model: its closed bones on their bodies, its motion, or the first free angle a little way.

    Raises
    ------
    InputError
        No motion is given, and no coordinate is an angle that is free.
    """
    bodies = list(dict.fromkeys(mesh.body for mesh in meshes if not mesh.fault))
    carried = ", ".join(f"{toml_string(body)} = [{toml_string(body + BETWEEN + '*')}]" for body in bodies)
    attached = [
        name
        for name, there in (
            ("muscle_paths.csv", any(point.of for point in model.points)),
            ("markers.csv", any(point.kind == "Marker" for point in model.points)),
        )
        if there
    ]
    lines = [
        f"title = {toml_string('OpenSim model ' + model.name)}",
        "",
        "[anatomy]",
        'folder = "bones"',
        'frame = "OpenSim ground, default pose"',
        *([f"points = [{', '.join(map(toml_string, attached))}]"] if attached else []),
        "[anatomy.kinds]",
        '"*" = "bone"',
        "",
        "[drive]",
        'kind = "opensim"',
        f'model = "{MODEL}"',
        f"carried = {{ {carried} }}",
        f"motion = {toml_string(motion)}" if motion else f"pose = {{ {_first_pose(model)} }}",
        *([f'markers_up = "{frame.up}"'] if frame and frame.up else []),
        *([f"markers_shift_mm = {list(frame.shift_mm)}"] if frame and any(frame.shift_mm) else []),
    ]
    return "\n".join(lines) + "\n"


def _first_pose(model: OpenSimModel) -> str:
    """A third of the way to the end of the first angle that is free."""
    followers = {coupler.dependent for coupler in model.multibody.couplers}
    for of in model.multibody.coordinates.values():
        if of.kind is CoordinateKind.ROTATIONAL and not of.locked and of.name not in followers:
            end = of.high if abs(of.high - of.default) >= abs(of.low - of.default) else of.low
            end = end if np.isfinite(end) else of.default + 1.0
            degrees = np.rad2deg(of.default + (end - of.default) / 3.0)
            return f"{toml_string(of.name + '_deg')} = {degrees:.1f}"
    raise InputError(f"{model.source}: no coordinate is an angle that is free; give a motion with --motion")


def _pointscsv_of(model: OpenSimModel, *, muscles: bool) -> str:
    places = model.multibody.places({})
    rows = []
    for point in model.points:
        if bool(point.of) is not muscles or (not muscles and point.kind != "Marker"):
            continue
        x, y, z = places[point.body](point.at[None])[0].tolist()
        row = {"name": point.name, "x_mm": x, "y_mm": y, "z_mm": z, "body": point.body}
        rows.append(row | ({"muscle": point.of, "kind": point.kind} if muscles else {}))
    return csv_of(rows)


def _wrapscsv_of(model: OpenSimModel) -> str:
    places = model.multibody.places({})
    rows = []
    for wrap in model.wraps:
        place = places[wrap.body] @ wrap.place
        x, y, z = place.translation.tolist()
        axis = dict(zip(("axis_x", "axis_y", "axis_z"), place.rotation[:, 2].tolist(), strict=True))
        sizes = " ".join(f"{size:.6g}" for size in wrap.sizes_mm)
        row = {"name": wrap.name, "x_mm": x, "y_mm": y, "z_mm": z, "body": wrap.body, "kind": wrap.kind}
        rows.append({**row, **axis, "sizes_mm": sizes})
    return csv_of(rows)


def _coordinate_rows(model: OpenSimModel) -> Iterable[dict[str, Any]]:
    coupled = {coupler.dependent: coupler.independent for coupler in model.multibody.couplers}
    for of in model.multibody.coordinates.values():
        factor = 180.0 / np.pi if of.kind is CoordinateKind.ROTATIONAL else 1.0
        yield {
            "name": of.name,
            "joint": of.joint,
            "kind": of.kind.value,
            "unit": "deg" if of.kind is CoordinateKind.ROTATIONAL else "m",
            "default": of.default * factor,
            "low": of.low * factor,
            "high": of.high * factor,
            "clamped": of.clamped,
            "locked": of.locked,
            "follows": coupled.get(of.name, ""),
        }

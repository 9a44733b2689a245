"""OpenSim's and ezc3d's libraries in a process of their own: ``given.npz`` of the current folder -> ``answer.npz``.

Started by `musclefit.io.libraries.process` in a temporary folder; imports nothing of musclefit. What cannot be done is
told in ``problem.json``: whether the library is missing, or what it says.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Arrays = dict[str, Any]
MODEL, RECORDING = "model.osim", "recording.c3d"
SHIFTS, SHIFT_M = 200, 1e-4
"""Most steps to a shift, and the step that ends them."""


def read_c3d(given: Arrays) -> Arrays:
    """Labels, unit, rate, first frame and the points, (frames, m, 3); not a number where a point was not seen."""
    del given
    import ezc3d

    read = ezc3d.c3d(RECORDING)
    parameters = read["parameters"].get("POINT", {})
    places = np.asarray(read["data"]["points"], dtype=np.float64)[:3].transpose(2, 1, 0).copy()
    residuals = np.asarray(read["data"]["meta_points"]["residuals"], dtype=np.float64)[0].T
    places[residuals < 0.0] = np.nan
    labels: list[str] = []
    for key in ("LABELS", *(f"LABELS{k}" for k in range(2, 100))):
        labels += [str(label) for label in parameters.get(key, {}).get("value", [])]
    units = parameters.get("UNITS", {}).get("value", [])
    header = read["header"]["points"]
    return {
        "positions": places,
        "labels": np.array(labels, dtype=str),
        "unit": np.array(str(units[0]) if len(units) else ""),
        "rate": np.array(float(header["frame_rate"])),
        "first_frame": np.array(int(header["first_frame"])),
    }


def inverse_kinematics(given: Arrays) -> Arrays:
    """Coordinates of the model at each time, (frames, c), by OpenSim's solver; every marker has the same weight."""
    opensim = _opensim()
    model = opensim.Model(MODEL)
    state = model.initSystem()
    times = given["times"].tolist()
    solver = _solver(opensim, model, given, times, given["positions_m"])
    coordinates = model.getCoordinateSet()
    names = [coordinates.get(k).getName() for k in range(coordinates.getSize())]
    values = np.empty((len(times), len(names)))
    for row, time in enumerate(times):
        state.setTime(time)
        (solver.track if row else solver.assemble)(state)
        values[row] = [coordinates.get(k).getValue(state) for k in range(len(names))]
        print(f"{row + 1}/{len(times)}", flush=True)
    return {"names": np.array(names, dtype=str), "values": values}


def fitting_shift(given: Arrays) -> Arrays:
    """The shift (3,) of the first time's markers that brings them nearest to the model's, and what is left, rms."""
    opensim = _opensim()
    model = opensim.Model(MODEL)
    times = given["times"].tolist()[:1]
    seen = np.isfinite(given["positions_m"][0]).all(axis=1)
    markers = [model.getMarkerSet().get(str(label)) for label in given["labels"]]
    shift = np.zeros(3)
    for _ in range(SHIFTS):
        state = model.initSystem()
        places = given["positions_m"][:1] + shift
        state.setTime(times[0])
        _solver(opensim, model, given, times, places).assemble(state)
        model.realizePosition(state)
        off = np.array([_three(marker.getLocationInGround(state)) for marker in markers])[seen] - places[0][seen]
        shift = shift + off.mean(axis=0)
        if np.linalg.norm(off.mean(axis=0)) < SHIFT_M:
            break
    return {"shift_m": shift, "rms_m": np.sqrt(((off - off.mean(axis=0)) ** 2).sum(axis=1).mean())}


def _solver(opensim: Any, model: Any, given: Arrays, times: list[float], positions: Any) -> Any:
    labels = [str(label) for label in given["labels"]]
    table = opensim.TimeSeriesTableVec3()
    table.setColumnLabels(labels)
    table.addTableMetaDataString("Units", "m")
    for time, places in zip(times, positions.tolist(), strict=True):
        row = opensim.RowVectorVec3(len(labels))
        for k, place in enumerate(places):
            row[k] = opensim.Vec3(*place)
        table.appendRow(time, row)
    weights = opensim.SetMarkerWeights()
    for label in labels:
        weights.cloneAndAppend(opensim.MarkerWeight(label, 1.0))
    solver = opensim.InverseKinematicsSolver(
        model, opensim.MarkersReference(table, weights), opensim.SimTKArrayCoordinateReference(), math.inf
    )
    solver.setAccuracy(float(given["accuracy"]))
    return solver


def muscle_paths(given: Arrays) -> Arrays:
    """Lengths, moment arms and path points of every muscle in every pose.

    ``coordinates`` (c,) and ``values`` (k, c) are the poses; ``pairs`` (p, 2) the muscles and coordinates whose moment
    arms are asked for. A muscle without a path raises TypeError.
    """
    opensim = _opensim()
    model = opensim.Model(MODEL)
    state = model.initSystem()
    coordinates = model.getCoordinateSet()
    of = {coordinates.get(k).getName(): coordinates.get(k) for k in range(coordinates.getSize())}
    forces = model.getForceSet()
    paths = {}
    for name in (str(name) for name in given["muscles"]):
        paths[name] = _path(opensim, forces.get(name))
    pairs = [(str(muscle), str(coordinate)) for muscle, coordinate in given["pairs"].reshape(-1, 2)]
    poses = given["values"]
    lengths = np.empty((len(poses), len(paths)))
    arms = np.empty((len(poses), len(pairs)))
    points: list[list[float]] = []
    counts = np.empty((len(poses), len(paths)), dtype=np.int64)
    for row, pose in enumerate(poses.tolist()):
        for name, value in zip(given["coordinates"], pose, strict=True):
            one = of[str(name)]
            one.setLocked(state, False)
            one.setValue(state, value, False)
        model.realizePosition(state)
        for k, path in enumerate(paths.values()):
            lengths[row, k] = path.getLength(state)
            line = _line(opensim, path, state)
            counts[row, k] = len(line)
            points += line
        for k, (muscle, coordinate) in enumerate(pairs):
            arms[row, k] = paths[muscle].computeMomentArm(state, of[coordinate])
        print(f"{row + 1}/{len(poses)}", flush=True)
    return {"lengths_m": lengths, "arms_m": arms, "points_m": np.array(points).reshape(-1, 3), "counts": counts}


def _path(opensim: Any, force: Any) -> Any:
    """The path of a muscle, ligament, spring or whatever has one."""
    for name in ("PathActuator", "Ligament", "PathSpring", "Blankevoort1991Ligament"):
        kind = getattr(opensim, name, None)
        found = kind.safeDownCast(force) if kind is not None else None
        if found is not None:
            return found.getGeometryPath()
    raise TypeError(f"{force.getName()} is a {force.getConcreteClassName()}, whose path cannot be asked for")


def _line(opensim: Any, path: Any, state: Any) -> list[list[float]]:
    """The path's points in the ground, the ones on wrap objects included."""
    line: list[list[float]] = []
    current = path.getCurrentPath(state)
    for k in range(current.getSize()):
        point = current.get(k)
        wrap = opensim.PathWrapPoint.safeDownCast(point)
        if wrap is not None:
            frame, on_surface = point.getParentFrame(), wrap.getWrapPath(state)
            places = (on_surface.get(j) for j in range(on_surface.getSize()))
            line += [_three(frame.findStationLocationInGround(state, place)) for place in places]
            continue
        line.append(_three(point.getLocationInGround(state)))
    return line


def _three(vector: Any) -> list[float]:
    return [vector.get(0), vector.get(1), vector.get(2)]


def _opensim() -> Any:
    import opensim

    opensim.Logger.setLevelString("Off")
    return opensim


TASKS: Mapping[str, Callable[[Arrays], Arrays]] = {
    "read_c3d": read_c3d,
    "inverse_kinematics": inverse_kinematics,
    "fitting_shift": fitting_shift,
    "muscle_paths": muscle_paths,
}


def main(task: str) -> int:
    """Do a task."""
    problem: dict[str, str]
    try:
        with np.load("given.npz", allow_pickle=False) as stored:
            given = dict(stored)
        np.savez("answer.npz", **TASKS[task](given))
        return 0
    except ImportError as error:
        problem = {"missing": str(error)}
    except Exception as error:
        problem = {"said": f"{type(error).__name__}: {error}"}
    with open("problem.json", "w", encoding="utf-8") as file:  # noqa: PTH123 (as little as may be is imported here)
        json.dump(problem, file)
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))

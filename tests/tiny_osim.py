"""A small OpenSim model of our own: four bones, joints of several kinds, a spline, a coupler, a muscle, a marker."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh


def body(name: str, mesh: str = "") -> str:
    geometry = (
        f'<attached_geometry><Mesh name="{name}_geom"><socket_frame>..</socket_frame>'
        f"<scale_factors>1 1.2 1</scale_factors><mesh_file>{mesh}</mesh_file></Mesh></attached_geometry>"
        if mesh
        else ""
    )
    wraps = (
        '<WrapObjectSet name="wrapobjectset"><objects><WrapCylinder name="round"><xyz_body_rotation>0.1 0.2 0'
        "</xyz_body_rotation><translation>0 0.01 0</translation><radius>0.01</radius><length>0.05</length>"
        "</WrapCylinder></objects><groups/></WrapObjectSet>"
        if name == "thigh"
        else ""
    )
    return (
        f'<Body name="{name}">{geometry}{wraps}<mass>1</mass><mass_center>0 -0.01 0</mass_center>'
        "<inertia>0.1 0.1 0.1 0 0 0</inertia></Body>"
    )


def coordinate(name: str, default: float, low: float, high: float, *, locked: str = "false") -> str:
    return (
        f'<Coordinate name="{name}"><default_value>{default}</default_value><range>{low} {high}</range>'
        f"<clamped>true</clamped><locked>{locked}</locked></Coordinate>"
    )


def joint(kind: str, name: str, parent: str, child: str, at: str, coordinates: str, inner: str = "") -> str:
    parent_path = "/ground" if parent == "ground" else f"/bodyset/{parent}"
    return (
        f'<{kind} name="{name}"><socket_parent_frame>{parent}_offset</socket_parent_frame>'
        f"<socket_child_frame>{child}_offset</socket_child_frame><coordinates>{coordinates}</coordinates><frames>"
        f'<PhysicalOffsetFrame name="{parent}_offset"><socket_parent>{parent_path}</socket_parent>'
        f"<translation>{at}</translation><orientation>0.1 -0.2 0.3</orientation></PhysicalOffsetFrame>"
        f'<PhysicalOffsetFrame name="{child}_offset"><socket_parent>/bodyset/{child}</socket_parent>'
        "<translation>0 0.05 0</translation><orientation>0 0.1 0</orientation></PhysicalOffsetFrame></frames>"
        f"{inner}</{kind}>"
    )


def axis(name: str, direction: str, of: str, function: str) -> str:
    turn = f"<coordinates>{of}</coordinates><axis>{direction}</axis>{function}"
    return f'<TransformAxis name="{name}">{turn}</TransformAxis>'


LINEAR = '<LinearFunction name="function"><coefficients>1 0</coefficients></LinearFunction>'
CONSTANT = '<Constant name="function"><value>0.003</value></Constant>'
SPLINE = '<SimmSpline name="function"><x>-2 -1 -0.4 0 0.5 1.5</x><y>0.01 -0.004 0.002 0 0.006 -0.003</y></SimmSpline>'
TIMES = f'<MultiplierFunction name="function"><function>{SPLINE}</function><scale>1.7</scale></MultiplierFunction>'
PIECES = '<PiecewiseLinearFunction name="function"><x>-2 0 2</x><y>0.01 0 -0.02</y></PiecewiseLinearFunction>'
POLYNOMIAL = '<PolynomialFunction name="function"><coefficients>0.01 -0.02 0.1 0</coefficients></PolynomialFunction>'

KNEE = (
    "<SpatialTransform>"
    + "".join(
        (
            axis("rotation1", "0 0 1", "knee", LINEAR),
            axis("rotation2", "0 1 0", "knee", POLYNOMIAL),
            axis("rotation3", "1 0 0", "", '<Constant name="function"><value>0.05</value></Constant>'),
            axis("translation1", "1 0 0", "knee", TIMES),
            axis("translation2", "0 1 0", "knee", PIECES),
            axis("translation3", "0 0 1", "", CONSTANT),
        )
    )
    + "</SpatialTransform>"
)

COUPLER = (
    '<CoordinateCouplerConstraint name="cap"><isEnforced>true</isEnforced><coupled_coordinates_function>'
    "<SimmSpline><x>-2 -1 0 2</x><y>-1.2 -0.4 0 0.7</y></SimmSpline></coupled_coordinates_function>"
    "<independent_coordinate_names>knee</independent_coordinate_names>"
    "<dependent_coordinate_name>cap_angle</dependent_coordinate_name></CoordinateCouplerConstraint>"
)

MUSCLE = (
    '<Millard2012EquilibriumMuscle name="puller"><GeometryPath name="geometrypath"><PathPointSet><objects>'
    '<PathPoint name="puller-P1"><socket_parent_frame>/bodyset/thigh</socket_parent_frame>'
    "<location>0.02 0.02 0</location></PathPoint>"
    '<PathPoint name="puller-P2"><socket_parent_frame>/bodyset/shank</socket_parent_frame>'
    "<location>0.02 -0.02 0</location></PathPoint></objects></PathPointSet></GeometryPath>"
    "<optimal_fiber_length>0.05</optimal_fiber_length><tendon_slack_length>0.06</tendon_slack_length>"
    "</Millard2012EquilibriumMuscle>"
)

MODEL = f"""<?xml version="1.0" encoding="UTF-8" ?>
<!-- kept: a remark -->
<OpenSimDocument Version="40000"><Model name="tiny">
<BodySet name="bodyset"><objects>
{body("hip", "hip.stl")}{body("thigh", "thigh.stl")}{body("shank", "shank.stl")}{body("cap")}{body("foot", "foot.stl")}
</objects><groups/></BodySet>
<JointSet name="jointset"><objects>
{
    joint(
        "BallJoint",
        "hipjoint",
        "hip",
        "thigh",
        "0 -0.1 0",
        coordinate("a", 0.1, -2, 2) + coordinate("b", 0.2, -2, 2) + coordinate("c", 0, -2, 2),
    )
}
{joint("CustomJoint", "kneejoint", "thigh", "shank", "0 -0.1 0", coordinate("knee", 0.2, -2, 2), KNEE)}
{joint("PinJoint", "capjoint", "shank", "cap", "0.03 0 0", coordinate("cap_angle", 0, -3, 3))}
{
    joint(
        "UniversalJoint",
        "ankle",
        "shank",
        "foot",
        "0 -0.1 0",
        coordinate("flex", 0, -1, 1) + coordinate("tilt", 0.1, -1, 1, locked="true"),
    )
}
{
    joint(
        "FreeJoint",
        "root",
        "ground",
        "hip",
        "0 0 0",
        "".join(coordinate(n, 0, -2, 2) for n in ("rx", "ry", "rz", "tx", "ty", "tz")),
    )
}
</objects><groups/></JointSet>
<ConstraintSet name="constraintset"><objects>{COUPLER}</objects><groups/></ConstraintSet>
<ForceSet name="forceset"><objects>{MUSCLE}</objects><groups/></ForceSet>
<MarkerSet name="markerset"><objects><Marker name="heel"><socket_parent_frame>/bodyset/foot</socket_parent_frame>
<location>0 0.01 0.02</location></Marker></objects><groups/></MarkerSet>
</Model></OpenSimDocument>
"""

MOTION = """Coordinates
version=1
nRows=3
nColumns=4
inDegrees=yes
endheader
time\tknee\ttx\tfoo
0\t0\t0\t1
0.5\t-30\t0.01\t1
1\t-60\t0.02\t1
"""


def write_tiny_osim(folder: Path) -> Path:
    """The model, its geometry and ``walk.mot``; the path of the model."""
    (folder / "Geometry").mkdir(parents=True)
    for name, radius in (("hip", 0.03), ("thigh", 0.025), ("shank", 0.025), ("foot", 0.02)):
        trimesh.creation.icosphere(subdivisions=2, radius=radius).export(folder / "Geometry" / f"{name}.stl")
    path = folder / "tiny.osim"
    path.write_text(MODEL, encoding="utf-8")
    (folder / "walk.mot").write_text(MOTION, encoding="utf-8")
    return path


def posed_in_opensim(path: Path, values: dict[str, float]) -> tuple[Any, Any]:
    """The model and its state at coordinates' values by OpenSim's own library, locked ones set free."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import opensim
    opensim.Logger.setLevelString("Off")
    model = opensim.Model(str(path))
    state = model.initSystem()
    coordinates = model.getCoordinateSet()
    for k in range(coordinates.getSize()):
        one = coordinates.get(k)
        one.setLocked(state, False)
        one.setValue(state, values[one.getName()], False)
    model.realizePosition(state)
    return model, state


def opensim_places(path: Path, values: dict[str, float]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rotation and translation (mm) of each body in the ground by OpenSim's own library."""
    model, state = posed_in_opensim(path, values)
    places = {}
    bodies = model.getBodySet()
    for k in range(bodies.getSize()):
        place = bodies.get(k).getTransformInGround(state)
        turn = place.R().asMat33()
        rotation = np.array([[turn.get(i, j) for j in range(3)] for i in range(3)])
        places[bodies.get(k).getName()] = rotation, 1000.0 * np.array([place.p().get(i) for i in range(3)])
    return places


def offset_frame(name: str, parent: str, at: str, inside: str = "") -> str:
    """A frame that is turned and moved from another."""
    return (
        f'<PhysicalOffsetFrame name="{name}">{inside}<socket_parent>{parent}</socket_parent>'
        f"<translation>{at}</translation><orientation>0.3 0.1 -0.2</orientation></PhysicalOffsetFrame>"
    )


def marker(name: str, frame: str) -> str:
    return (
        f'<Marker name="{name}"><socket_parent_frame>{frame}</socket_parent_frame>'
        "<location>0 0.01 0.02</location></Marker>"
    )


def with_offset_frames() -> str:
    """The model with things in offset frames: of joints, where three have one name, of bodies, and in each other."""
    wrap = (
        '<WrapObjectSet name="wrapobjectset"><objects><WrapSphere name="ball"><xyz_body_rotation>0 0 0'
        "</xyz_body_rotation><translation>0 0.01 0</translation><radius>0.01</radius></WrapSphere></objects><groups/>"
        "</WrapObjectSet>"
    )
    mesh = (
        '<attached_geometry><Mesh name="toes"><socket_frame>..</socket_frame><mesh_file>foot.stl</mesh_file></Mesh>'
        "</attached_geometry>"
    )
    inner = offset_frame("plate", "/bodyset/foot", "0.01 0.02 0.03", wrap)
    outer = offset_frame("tip", "/bodyset/foot/plate", "0 0 0.04", mesh)
    markers = "".join(
        marker(name, frame)
        for name, frame in (
            ("at_knee", "/jointset/kneejoint/shank_offset"),
            ("at_cap", "/jointset/capjoint/shank_offset"),
            ("at_ankle", "../../jointset/ankle/shank_offset"),
            ("at_root", "/jointset/root/hip_offset"),
            ("on_tip", "/bodyset/foot/tip"),
        )
    )
    return (
        MODEL.replace('<Body name="foot">', f'<Body name="foot"><components>{inner}{outer}</components>')
        .replace('<MarkerSet name="markerset"><objects>', f'<MarkerSet name="markerset"><objects>{markers}')
        .replace("<socket_child_frame>foot_offset<", "<socket_child_frame>/jointset/ankle/foot_offset<")
        .replace(
            "<socket_parent>/bodyset/foot</socket_parent><translation>0 0.05 0",
            "<socket_parent>/bodyset/foot/plate</socket_parent><translation>0 0.05 0",
        )
    )


def opensim_markers(path: Path, values: dict[str, float]) -> dict[str, np.ndarray]:
    """Where OpenSim's own library has the markers, mm."""
    model, state = posed_in_opensim(path, values)
    found = [model.getMarkerSet().get(k) for k in range(model.getMarkerSet().getSize())]
    return {m.getName(): 1000.0 * np.array([m.getLocationInGround(state).get(i) for i in range(3)]) for m in found}


def opensim_point(path: Path, values: dict[str, float], number: int) -> np.ndarray:
    """Where OpenSim's own library has a path point of the first muscle, in its body's frame, mm."""
    model, state = posed_in_opensim(path, values)
    point = model.getMuscles().get(0).getGeometryPath().getPathPointSet().get(number)
    return 1000.0 * np.array([point.getLocation(state).get(i) for i in range(3)])

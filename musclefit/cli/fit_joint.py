"""The command that fits a joint's axis or centre to two bones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter

PASSED = 0

SURE_DEG = 60.0
"""An axis of less of a cylinder is uncertain."""


def fit_joint(
    fixed: Annotated[Path, Parameter(help="Surface of the bone that carries the joint: PLY, STL, OBJ, VTP.")],
    moving: Annotated[Path, Parameter(help="Surface of the bone that the joint moves.")],
    /,
    *,
    kind: Annotated[Literal["hinge", "ball"], Parameter(name="--kind", show_default=True)] = "hinge",
    within_mm: Annotated[
        float, Parameter(name="--within-mm", help="Surfaces of the two within this distance count.", show_default=True)
    ] = 5.0,
    units: Annotated[Literal["mm", "cm", "m"], Parameter(name="--units", show_default=True)] = "mm",
) -> int:
    """Print a joint for a table of joints, fitted where two bones face each other, with what the fit leaves over."""
    from musclefit.geometry.fitting import CylinderFit
    from musclefit.io.anatomy import read_surface
    from musclefit.rig.articulation import fitted_joint
    from musclefit.rig.joint_kinds import JointKind
    from musclefit.vocabulary import Unit

    surfaces = [read_surface(path, units=Unit(units)).mesh() for path in (fixed, moving)]
    fits = fitted_joint(surfaces[0], surfaces[1], kind=JointKind(kind), within_mm=within_mm)
    best = fits[0].fit
    lines = ['units = "mm, degrees"', "", "[joint]                  # name it, and add the other bones that it moves"]
    if kind == "ball":
        axes, names = np.eye(3).tolist(), '["joint_x", "joint_y", "joint_z"]'
        lines += ['kind = "ball"', f"axes = {axes}", f"coordinates = {names}"]
    elif isinstance(best, CylinderFit):
        lines.append(f"axis = {_listed(best.axis, 6)}")
    lines += [f"centre_mm = {_listed(best.centre, 3)}", f'fixed = ["{fixed.stem}"]', f'moving = ["{moving.stem}"]', ""]
    for found in fits:
        fit = found.fit
        most = np.abs(fit.residuals).max()
        lines.append(
            f"# {found.of} bone: radius {fit.radius:.2f} mm, off by {fit.rms:.2f} mm rms and {most:.2f} mm at most on "
            f"{found.used_mm2:.0f} mm², {found.left_out_mm2:.0f} mm² left out"
        )
        if isinstance(fit, CylinderFit):
            uncertain = ", too little to be sure of it" if fit.spread < SURE_DEG else ""
            lines[-1] += f", which reach {fit.spread:.0f} deg around the axis{uncertain}"
    apart = fits[1].fit.centre - best.centre
    if isinstance(best, CylinderFit) and isinstance(fits[1].fit, CylinderFit):
        apart = apart - (apart @ best.axis) * best.axis
        turned = float(np.degrees(np.arccos(np.clip(abs(best.axis @ fits[1].fit.axis), 0.0, 1.0))))
        lines.append(f"# the axes of the two bones differ by {turned:.1f} deg and {np.linalg.norm(apart):.2f} mm")
    else:
        lines.append(f"# the centres of the two bones are {np.linalg.norm(apart):.2f} mm apart")
    print("\n".join(lines))
    return PASSED


def _listed(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]], decimals: int) -> str:
    return str([round(float(v), decimals) for v in values])

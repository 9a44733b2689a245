"""A model for FEBio held against what is independent of musclefit: ``python tests/febio_assembly.py model.feb``.

Elements have positive Jacobians; linear elasticity on the mesh, assembled by scikit-fem in parts of `PART` elements, is
symmetric and gives no force to the six rigid motions; sections other than mesh and axes are read by pyfebio, and every
part, set and surface that they name is there, and so it is in contact; nodes, rigid node sets and ties lead from every
part to a rigid bone. Prints what it measured; exit code 1 where something does not hold.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import skfem
from pyfebio import control, loaddata, material, meshdomains, output, rigid
from skfem.models.elasticity import lame_parameters, linear_elasticity

PART = 50_000
LEAST = 1e-12
"""Asymmetry and forces, over the largest entry of the stiffness (per mm of motion)."""

SECTIONS: Mapping[str, Callable[[bytes], Any]] = {
    "Control": control.Control.from_xml,
    "Material": material.Material.from_xml,
    "MeshDomains": meshdomains.MeshDomains.from_xml,
    "Rigid": rigid.Rigid.from_xml,
    "LoadData": loaddata.LoadData.from_xml,
    "Output": output.Output.from_xml,
}


@dataclass(frozen=True)
class Held:
    """What was measured of a model; ``unread`` are sections that pyfebio refused, ``undefined`` names not there,
    ``loose`` parts that nothing leads from to a bone.
    """

    nodes: int
    elements: int
    smallest_jacobian_mm3: float
    asymmetry: float
    rigid_force: float
    unread: Mapping[str, str]
    undefined: tuple[str, ...]
    loose: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing is wrong."""
        sound = self.smallest_jacobian_mm3 > 0.0 and max(self.asymmetry, self.rigid_force) < LEAST
        return sound and not self.unread and not self.undefined and not self.loose


def held(path: Path) -> Held:
    """Measure a model."""
    root = ET.parse(path).getroot()
    points = _table(root.iterfind("Mesh/Nodes/node"))
    corners = _table(root.iterfind("Mesh/Elements/elem")).astype(np.int64) - 1
    jacobians = np.linalg.det(points[corners[:, 1:]] - points[corners[:, :1]])
    asymmetry, force = _assembled(points - points.mean(axis=0), corners)
    return Held(
        nodes=len(points),
        elements=len(corners),
        smallest_jacobian_mm3=float(jacobians.min()),
        asymmetry=asymmetry,
        rigid_force=force,
        unread=_unread(root),
        undefined=tuple(_undefined(root)),
        loose=tuple(_loose(root)),
    )


def _table(rows: Any) -> Any:
    return np.array([[float(x) for x in (row.text or "").split(",")] for row in rows])


def _assembled(points: Any, corners: Any) -> tuple[float, float]:
    """Largest asymmetry and force under a rigid motion of 1 mm at the farthest node, over the largest stiffness."""
    motions = np.zeros((6, len(points), 3))
    motions[[0, 1, 2], :, [0, 1, 2]] = 1.0
    motions[3:] = np.cross(np.eye(3)[:, None], points[None]) / np.linalg.norm(points, axis=1).max()
    forces, largest, asymmetry = np.zeros_like(motions), 0.0, 0.0
    for first in range(0, len(corners), PART):
        used, own = np.unique(corners[first : first + PART], return_inverse=True)
        mesh = skfem.MeshTet(points[used].T, own.reshape(-1, 4).T)
        basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP1()))
        stiffness = linear_elasticity(*lame_parameters(1.0, 0.3)).assemble(basis)
        largest = max(largest, float(abs(stiffness).max()))
        asymmetry = max(asymmetry, float(abs(stiffness - stiffness.T).max()))
        for motion, force in zip(motions, forces, strict=True):
            given = np.zeros(stiffness.shape[0])
            given[basis.nodal_dofs] = motion[used].T
            force[used] += (stiffness @ given)[basis.nodal_dofs].T
    return asymmetry / largest, float(np.abs(forces).max()) / largest


def _unread(root: ET.Element) -> dict[str, str]:
    """Sections that pyfebio refuses, and why; a bone that stays is written as FEBio wants it, which pyfebio refuses."""
    found = {}
    for tag, read in SECTIONS.items():
        (section,) = root.iterfind(tag)
        for fixed in section.findall("rigid_bc[@type='rigid_fixed']"):
            section.remove(fixed)
        try:
            read(ET.tostring(section))
        except Exception as error:
            found[tag] = str(error)[:200]
    return found


def _undefined(root: ET.Element) -> list[str]:
    parts = {one.attrib["name"] for one in root.iterfind("Mesh/Elements")}
    sets = {one.attrib["name"] for one in root.iterfind("Mesh/NodeSet")}
    bodies = {one.attrib["name"] for one in root.iterfind("Material/material")}
    curves = {one.attrib["id"] for one in root.iterfind("LoadData/load_controller")}
    wanted = [(one.attrib["name"], parts) for one in root.iterfind("MeshDomains/SolidDomain")]
    wanted += [(one.attrib["mat"], bodies) for one in root.iterfind("MeshDomains/SolidDomain")]
    wanted += [(one.attrib["elem_set"], parts) for one in root.iterfind("MeshData/ElementData")]
    wanted += [(one.attrib["node_set"], sets) for one in root.iter("bc") if "node_set" in one.attrib]
    surfaces = {one.attrib["name"] for one in root.iterfind("Mesh/Surface")}
    pairs = {one.attrib["name"] for one in root.iterfind("Mesh/SurfacePair")}
    wanted += [(one.text or "", surfaces) for one in root.iterfind("Mesh/SurfacePair/*")]
    wanted += [(one.attrib["surface_pair"], pairs) for one in root.iterfind("Contact/contact")]
    wanted += [(one.text or "", bodies) for one in root.iterfind("Boundary/bc/rb")]
    wanted += [(one.text or "", bodies) for one in root.iterfind("Rigid/rigid_bc/rb")]
    wanted += [(one.attrib["lc"], curves) for one in root.iter() if "lc" in one.attrib]
    return [name for name, there in wanted if name not in there]


def _loose(root: ET.Element) -> list[str]:
    """Parts that may drift away: no node in common, tie or rigid node set, one after the other, leads to a bone."""
    domains = {one.attrib["name"]: one.attrib["mat"] for one in root.iterfind("MeshDomains/SolidDomain")}
    nodes = {one.attrib["name"]: _numbers(one.iterfind("elem")) for one in root.iterfind("Mesh/Elements")}
    surfaces = {one.attrib["name"]: _numbers(one.iterfind("tri3")) for one in root.iterfind("Mesh/Surface")}
    sets = {one.attrib["name"]: _numbers([one]) for one in root.iterfind("Mesh/NodeSet")}
    pairs = {
        pair.attrib["name"]: [surfaces.get(one.text or "", set()) for one in pair]
        for pair in root.iterfind("Mesh/SurfacePair")
    }
    bones = {one.attrib["name"] for one in root.iterfind("Material/material[@type='rigid body']")}
    held = set().union(*(own for name, own in nodes.items() if domains.get(name) in bones))
    held |= set().union(
        *(sets.get(one.attrib["node_set"], set()) for one in root.iterfind("Boundary/bc[@type='rigid']"))
    )
    links = [own for name, own in nodes.items() if domains.get(name) not in bones]
    ties = [one.attrib["surface_pair"] for one in root.iterfind("Contact/contact[@type='tied-elastic']")]
    links += [set().union(*pairs.get(name, [])) for name in ties]
    waiting = links
    while waiting:
        further = [own for own in waiting if not own & held]
        if len(further) == len(waiting):
            break
        held |= set().union(*(own for own in waiting if own & held))
        waiting = further
    return [name for name, own in nodes.items() if not own <= held]


def _numbers(rows: Any) -> set[int]:
    return {int(x) for row in rows for x in (row.text or "").split(",")}


def main() -> int:
    """Measure the model that the command line names."""
    found = held(Path(sys.argv[1]))
    print(
        f"{found.nodes} nodes, {found.elements} elements, smallest Jacobian {found.smallest_jacobian_mm3:.3g} mm3; "
        f"asymmetry {found.asymmetry:.1g}, force of rigid motions {found.rigid_force:.1g} of the largest stiffness"
    )
    for tag, why in found.unread.items():
        print(f"{tag}: not read by pyfebio: {why}")
    for name in found.undefined:
        print(f"{name}: named, but not there")
    for name in found.loose:
        print(f"{name}: nothing leads from it to a bone")
    print("holds" if found.holds else "does not hold")
    return int(not found.holds)


if __name__ == "__main__":
    sys.exit(main())

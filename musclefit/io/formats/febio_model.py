"""A model for FEBio 4, from tetrahedra at rest: muscles with fibres, rigid bones on their way, soft filler.

Tissues that share the nodes of their common faces are tied to each other by them; others are tied, or slide, by contact
pairs. Bones that move as one are one rigid body, and go along the screw from rest to their pose.

Format: febio_spec 4.0 (FEBio User Manual 4). Muscle: "muscle material", S. S. Blemker, P. M. Pinsky and S. L. Delp, A
3D model of muscle reveals the causes of nonuniform strains in the biceps brachii, J. Biomech. 38 (2005) 657, with the
numbers that FEBio's manual gives for it, in MPa, at rest (no activation).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.tets.topology import tet_faces
from musclefit.io.atomic import write_bytes_atomically
from musclefit.io.formats.febio_contacts import (
    ContactPair,
    contact_lines,
    pair_lines,
    rigid_nodes,
    surface_lines,
    surface_name,
)
from musclefit.io.formats.solvers import LabelledTets

STEPS = 20
"""Steps of the load, and points of the curves that bones go along."""

MUSCLE: Mapping[str, str] = {
    "density": "1.06e-09",
    "g1": "5e-04",
    "g2": "5e-04",
    "p1": "0.05",
    "p2": "6.6",
    "smax": "0.3",
    "Lofl": "1.07",
    "lam_max": "1.4",
    "k": "1",
}
"""Blemker's muscle in N, mm and tonnes: moduli and stress in MPa; the bulk modulus is FEBio's 1e6 Pa."""

SOFT: Mapping[str, str] = {"density": "1e-09", "E": "0.003", "v": "0.45"}
"""Placeholder for whatever is neither muscle nor bone: neo-Hookean, E 3 kPa."""

SAME_MM = 1e-3
"""Bones whose motions differ by less than this on all their nodes are one rigid body."""


@dataclass(frozen=True, eq=False, slots=True)
class FebioModel:
    """What a model is made of.

    Parameters
    ----------
    tets : LabelledTets
        At rest: the stress-free reference.
    fibres : (k, 3) float64
        For each tet its fibre's direction, of length 1; 0 where it has none.
    motions : mapping of name to RigidMotion
        Of every tissue that is a rigid bone.
    muscles : frozenset of str
        Names of the tissues that are muscles; the others are soft.
    contacts : tuple of ContactPair
        By labels of the parts.

    Raises
    ------
    InputError
        No rigid bone, a motion of a tissue that is not there, or bones that move apart share a node.
    """

    tets: LabelledTets
    fibres: Points
    motions: Mapping[str, RigidMotion]
    muscles: frozenset[str]
    contacts: tuple[ContactPair, ...] = ()

    def __post_init__(self) -> None:
        unknown = sorted(set(self.motions) - set(self.names.values()))
        if not self.motions or unknown:
            found = f"{unknown[0]!r} is not a tissue of the tetrahedra" if unknown else "no tissue is a rigid bone"
            raise InputError(f"the model needs rigid bones; found that {found}: name the kinds in [anatomy.kinds]")
        owner: dict[int, int] = {}
        for number, group in enumerate(self.bodies):
            for node in np.unique(self.tets.tets[np.concatenate([self.tets.sets[label] for label in group])]).tolist():
                if owner.setdefault(node, number) != number:
                    one, other = self.bodies[owner[node]][0], group[0]
                    raise InputError(
                        f"{one} and {other} move apart but share node {node + 1}: their surfaces touch within the "
                        "envelope of the tetrahedra; choose a smaller tets.envelope_fraction"
                    )

    @property
    def names(self) -> Mapping[str, str]:
        """The tissue's name of each part."""
        used = np.unique(self.tets.tissue_of_tet)
        return dict(zip(self.tets.sets, (self.tets.names[k] for k in used), strict=True))

    @property
    def bodies(self) -> list[list[str]]:
        """Parts that are bone, those together that move as one."""
        bones = [label for label, name in self.names.items() if name in self.motions]
        every = self.tets.vertices
        corners = np.array([every.min(axis=0), every.max(axis=0), [*every.min(axis=0)[:2], every[:, 2].max()]])
        groups: list[list[str]] = []
        for label in bones:
            here = self.motions[self.names[label]](corners)
            for group in groups:
                if np.abs(self.motions[self.names[group[0]]](corners) - here).max() < SAME_MM:
                    group.append(label)
                    break
            else:
                groups.append([label])
        return groups

    @property
    def attached(self) -> dict[str, list[int]]:
        """The nodes that go with a rigid bone, by the name of the pair that ties them."""
        bodies = {label: number for number, group in enumerate(self.bodies) for label in group}
        bones = [self.tets.sets[label] for label in bodies]
        return rigid_nodes(self.contacts, bodies, np.unique(self.tets.tets[np.concatenate(bones)]).tolist())

    @property
    def between(self) -> list[ContactPair]:
        """The pairs that are no ties to bone."""
        bones = {label for group in self.bodies for label in group}
        return [pair for pair in self.contacts if not (pair.tied and pair.secondary in bones)]


def write_febio_model(path: Path, model: FebioModel) -> None:
    """Write a model, whole or not at all.

    Raises
    ------
    InputError
        The path is no .feb, a folder, or in a folder that is not there.
    """
    if path.suffix.lower() != ".feb":
        raise InputError(f"{path}: a FEBio model ends in .feb")
    if path.is_dir() or not path.parent.is_dir():
        raise InputError(f"{path}: is a folder, or in one that is not there; name a file in a folder that exists")
    text = "".join(f"{line}\n" for line in _lines(model))
    write_bytes_atomically(path, text.encode("iso-8859-1", "xmlcharrefreplace"))


def _lines(model: FebioModel) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="ISO-8859-1"?>'
    yield f"<!-- {escape(model.tets.title).replace('--', '- -')}; mm, N, MPa, tonne; reference: the shape at rest -->"
    yield '<febio_spec version="4.0">\n<Module type="solid"/>'
    yield f"<Control>\n<analysis>STATIC</analysis>\n<time_steps>{STEPS}</time_steps>"
    yield f"<step_size>{1 / STEPS}</step_size>"
    yield '<time_stepper type="default">\n<max_retries>10</max_retries>\n<opt_iter>15</opt_iter>'
    yield f"<dtmin>{0.01 / STEPS}</dtmin>\n<dtmax>{1 / STEPS}</dtmax>\n</time_stepper>"
    yield '<solver type="solid">\n<symmetric_stiffness>symmetric</symmetric_stiffness>\n<max_refs>25</max_refs>'
    yield '<qn_method type="full Newton"/>\n</solver>\n</Control>'
    yield "<Globals>\n<Constants>\n<T>0</T>\n<P>0</P>\n<R>0</R>\n<Fc>0</Fc>\n</Constants>\n</Globals>"
    yield from _materials(model)
    yield from _mesh(model)
    yield from _fibres(model)
    if model.attached:
        yield "<Boundary>"
        secondary = {pair.name: pair.secondary for pair in model.contacts}
        body_of = {label: _body(group) for group in model.bodies for label in group}
        for name in model.attached:
            yield f'<bc name={quoteattr(name)} node_set={quoteattr(name)} type="rigid">'
            yield f"<rb>{escape(body_of[secondary[name]])}</rb>\n</bc>"
        yield "</Boundary>"
    yield from contact_lines(model.between)
    yield from _bones(model)
    yield '<Output>\n<plotfile type="febio">\n<var type="displacement"/>\n<var type="stress"/>'
    yield '<var type="fiber stretch"/>'
    if model.between:
        yield '<var type="contact gap"/>\n<var type="contact traction"/>'
    yield '<var type="fiber vector"/>\n<var type="relative volume"/>\n</plotfile>\n</Output>\n</febio_spec>'


def _materials(model: FebioModel) -> Iterator[str]:
    yield "<Material>"
    number = 0
    for number, group in enumerate(model.bodies, start=1):
        own = np.concatenate([model.tets.sets[label] for label in group])
        yield f'<material id="{number}" name={quoteattr(_body(group))} type="rigid body">\n<density>2e-09</density>'
        yield f"<center_of_mass>{_vector(_centre(model, own))}</center_of_mass>\n</material>"
    for label, name in model.names.items():
        if name in model.motions:
            continue
        number += 1
        muscle = name in model.muscles
        kind, values = ("muscle material", MUSCLE) if muscle else ("neo-Hookean", SOFT)
        yield f'<material id="{number}" name={quoteattr(label)} type="{kind}">'
        yield from (f"<{key}>{value}</{key}>" for key, value in values.items())
        if muscle:  # the first axis of the element's own, which MeshData gives
            yield '<fiber type="vector">1,0,0</fiber>'
        yield "</material>"
    yield "</Material>"


def _mesh(model: FebioModel) -> Iterator[str]:
    tets = model.tets
    yield '<Mesh>\n<Nodes name="all_nodes">'
    yield from (f'<node id="{k}">{_vector(place)}</node>' for k, place in enumerate(tets.vertices, start=1))
    yield "</Nodes>"
    for label, own in tets.sets.items():
        yield f'<Elements type="tet4" name={quoteattr(label)}>'
        corners = (tets.tets[own] + 1).tolist()
        yield from (f'<elem id="{k}">{a},{b},{c},{d}</elem>' for k, (a, b, c, d) in zip(own + 1, corners, strict=True))
        yield "</Elements>"
    for label, own in tets.sets.items():
        yield from surface_lines(surface_name(label), tet_faces(tets.tets[own]).boundary)
    for pair in model.between:
        yield from surface_lines(pair.name, pair.faces)
    for label, own in tets.sets.items():
        yield f"<NodeSet name={quoteattr(label + '_nodes')}>"
        yield ",".join(map(str, (np.unique(tets.tets[own]) + 1).tolist())) + "</NodeSet>"
    for name, nodes in model.attached.items():
        yield f"<NodeSet name={quoteattr(name)}>" + ",".join(str(node + 1) for node in nodes) + "</NodeSet>"
    yield from pair_lines(model.between)
    yield "</Mesh>\n<MeshDomains>"
    body_of = {label: _body(group) for group in model.bodies for label in group}
    for label in tets.sets:
        yield f"<SolidDomain name={quoteattr(label)} mat={quoteattr(body_of.get(label, label))}/>"
    yield "</MeshDomains>"


def _fibres(model: FebioModel) -> Iterator[str]:
    yield "<MeshData>"
    for label, name in model.names.items():
        if name not in model.muscles:
            continue
        yield f'<ElementData type="mat_axis" elem_set={quoteattr(label)}>'  # a part's name is a set of its elements
        for number, along in enumerate(model.fibres[model.tets.sets[label]], start=1):
            beside = np.eye(3)[np.abs(along).argmin()]
            yield f'<elem lid="{number}"><a>{_vector(along)}</a><d>{_vector(beside)}</d></elem>'
        yield "</ElementData>"
    yield "</MeshData>"


def _bones(model: FebioModel) -> Iterator[str]:
    curves: list[tuple[int, list[float]]] = [(1, np.linspace(0.0, 1.0, STEPS + 1).tolist())]
    yield "<Rigid>"
    for group in model.bodies:
        body, motion = escape(_body(group)), model.motions[model.names[group[0]]]
        centre = _centre(model, np.concatenate([model.tets.sets[label] for label in group]))
        way = np.array([motion.fraction(t)(centre[None])[0] - centre for t in np.linspace(0.0, 1.0, STEPS + 1)])
        turn = rotation_vector(motion)
        if np.abs(way).max() < SAME_MM and np.abs(turn).max() < 1e-9:
            fixed = "".join(f"<R{axis}_dof>1</R{axis}_dof>" for axis in "xyzuvw")
            yield f'<rigid_bc name={quoteattr(body + "_fixed")} type="rigid_fixed"><rb>{body}</rb>{fixed}</rigid_bc>'
            continue
        for axis, column in zip("xyz", way.T, strict=True):
            curves.append((len(curves) + 1, column.tolist()))
            yield f'<rigid_bc name={quoteattr(f"{body}_{axis}")} type="rigid_displacement"><rb>{body}</rb>'
            yield f'<dof>{axis}</dof><value lc="{len(curves)}">1</value><relative>0</relative></rigid_bc>'
        turns = "".join(
            f'<v{axis} lc="1">{value!r}</v{axis}>' for axis, value in zip("xyz", turn.tolist(), strict=True)
        )
        yield f'<rigid_bc name={quoteattr(body + "_turn")} type="rigid_rotation_vector"><rb>{body}</rb>'
        yield f"{turns}</rigid_bc>"
    yield "</Rigid>\n<LoadData>"
    for number, values in curves:
        yield f'<load_controller id="{number}" type="loadcurve">\n<interpolate>LINEAR</interpolate>\n<points>'
        yield from (f"<point>{k / STEPS!r},{value!r}</point>" for k, value in enumerate(values))
        yield "</points>\n</load_controller>"
    yield "</LoadData>"


def rotation_vector(motion: RigidMotion) -> Points:
    """(3,) the motion's rotation as axis times angle, radians."""
    from scipy.spatial.transform import Rotation

    vector: Points = Rotation.from_matrix(motion.rotation).as_rotvec()
    return vector


def _centre(model: FebioModel, own: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> Points:
    corners = model.tets.vertices[model.tets.tets[own]]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    centre: Points = np.average(corners.mean(axis=1), axis=0, weights=volumes)
    return centre


def _body(group: list[str]) -> str:
    return f"{group[0]}_body"


def _vector(values: Points) -> str:
    return ",".join(repr(float(value)) for value in values)

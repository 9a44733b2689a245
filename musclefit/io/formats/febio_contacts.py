"""Contact of a FEBio model: what is tied to bone, tied to other tissue or slides, as febio_spec 4.0 wants it.

What is tied to a rigid bone goes with it exactly, by its nodes (boundary condition "rigid"). Other ties are
"tied-elastic", which keeps the gap that it finds at the start, in directions that do not turn; what slides is
"sliding-elastic" without friction. Penalties are by FEBio's own estimate (FEBio User Manual 4).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

from musclefit.geometry.arrays import Faces

TIED: Mapping[str, str] = {
    "laugon": "PENALTY",
    "tolerance": "0.1",
    "penalty": "10",
    "auto_penalty": "1",
    "two_pass": "0",
    "search_tol": "0.01",
    "symmetric_stiffness": "1",
}

SLIDING: Mapping[str, str] = {
    "laugon": "PENALTY",
    "tolerance": "0.1",
    "gaptol": "0",
    "penalty": "1",
    "auto_penalty": "1",
    "update_penalty": "1",
    "two_pass": "0",
    "search_tol": "0.01",
    "symmetric_stiffness": "1",
    "tension": "0",
    "fric_coeff": "0",
    "node_reloc": "0",
}

REACHES = 3.0
"""A tie looks for the other surface along the normal as far as so many times the largest gap, and 1 mm."""


@dataclass(frozen=True, eq=False, slots=True)
class ContactPair:
    """Faces of one part that are tied to another, or slide on it.

    Parameters
    ----------
    primary, secondary : str
        Labels of the parts; the first is no rigid bone. Of the second, all its surface counts.
    faces : (f, 3) int64
        Nodes of the first part, counter-clockwise seen from outside.
    tied : bool
    gap_mm : float
        How far the faces' middles are, at most, from the second part.
    reason : str
        Why they are tied; empty where they slide.
    """

    primary: str
    secondary: str
    faces: Faces
    tied: bool
    gap_mm: float
    reason: str = ""

    @property
    def name(self) -> str:
        """Of the surface and the pair in the file."""
        return f"{self.primary}_{'tied_to' if self.tied else 'on'}_{self.secondary}"


def surface_name(label: str) -> str:
    """Of a part's whole boundary."""
    return f"{label}_surface"


def surface_lines(name: str, faces: Faces) -> Iterator[str]:
    """A surface of triangles, for the section Mesh."""
    yield f"<Surface name={quoteattr(name)}>"
    yield from (f'<tri3 id="{k}">{a},{b},{c}</tri3>' for k, (a, b, c) in enumerate((faces + 1).tolist(), start=1))
    yield "</Surface>"


def rigid_nodes(pairs: Sequence[ContactPair], bodies: Mapping[str, int], taken: Iterable[int]) -> dict[str, list[int]]:
    """By name the nodes that go with a rigid bone; one between two bones goes with the first.

    Parameters
    ----------
    pairs : sequence of ContactPair
        Those that are tied to bone count.
    bodies : mapping of label to number
        Of the parts that are bone.
    taken : iterable of int
        Nodes of the bones themselves.
    """
    known, found = set(taken), {}
    for pair in pairs:
        if pair.tied and pair.secondary in bodies:
            own = sorted({node for face in pair.faces.tolist() for node in face} - known)
            known.update(own)
            if own:
                found[pair.name] = own
    return found


def pair_lines(pairs: Sequence[ContactPair]) -> Iterator[str]:
    """Surface pairs, for the end of the section Mesh; the surfaces are there."""
    for pair in pairs:
        yield f"<SurfacePair name={quoteattr(pair.name + '_pair')}>\n<primary>{escape(pair.name)}</primary>"
        yield f"<secondary>{escape(surface_name(pair.secondary))}</secondary>\n</SurfacePair>"


def contact_lines(pairs: Sequence[ContactPair]) -> Iterator[str]:
    """The section Contact; nothing without pairs."""
    if not pairs:
        return
    yield "<Contact>"
    for pair in pairs:
        kind, values = ("tied-elastic", TIED) if pair.tied else ("sliding-elastic", SLIDING)
        name, of = quoteattr(pair.name), quoteattr(pair.name + "_pair")
        yield f'<contact name={name} surface_pair={of} type="{kind}">'
        yield from (f"<{key}>{value}</{key}>" for key, value in values.items())
        yield f"<search_radius>{REACHES * pair.gap_mm + 1.0!r}</search_radius>\n</contact>"
    yield "</Contact>"

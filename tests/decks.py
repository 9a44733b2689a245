"""Small decks of a block inside the tiny limb, as LS-DYNA, Abaqus and FEBio write them, with what a reader may meet."""

from __future__ import annotations

import numpy as np

SIZE = (4, 3, 3)
LOW, SPACING = np.array([-20.0, -6.0, -6.0]), np.array([13.0, 6.0, 6.0])


def grid_nodes() -> np.ndarray:
    """(36, 3) nodes of a block of 12 hexahedra, mm, off round numbers."""
    index = np.stack(np.meshgrid(*(range(n) for n in SIZE), indexing="ij"), axis=-1).reshape(-1, 3)
    return LOW + index * SPACING + 0.0123456789 * np.sin(np.arange(len(index) * 3).reshape(-1, 3))


def grid_hexes() -> list[list[int]]:
    """Corners of the block's hexahedra, from 0."""
    number = np.arange(np.prod(SIZE)).reshape(SIZE)
    found = []
    for i in range(SIZE[0] - 1):
        for j in range(SIZE[1] - 1):
            for k in range(SIZE[2] - 1):
                base = [number[i + a, j + b, k] for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
                found.append([int(n) for n in (*base, *(b + 1 for b in base))])
    return found


def lsdyna(*, ending: str = "\n", columns: str = "standard") -> bytes:
    """A keyword deck: hexahedra, a degenerate wedge and tetrahedron, a shell, a beam, a joint of coincident nodes."""
    number, place = {"standard": (8, 16), "long": (20, 20), "i10": (10, 16)}[columns]
    nodes, hexes = grid_nodes(), grid_hexes()
    header = {"standard": "*KEYWORD", "long": "*KEYWORD LONG=Y", "i10": "*KEYWORD I10=Y"}[columns]

    def card(*values: int) -> str:
        return "".join(str(value).rjust(number) for value in values)

    def node(k: int, at: np.ndarray, more: str = "") -> str:
        return str(k).rjust(number) + "".join(f"{x:.9g}".rjust(place) for x in at) + more

    lines = [header, "*TITLE", "block, \xe9\xff of bytes", "$ a comment", "*NODE", "$#   nid               x"]
    lines += [node(101 + k, at, "       0       7" if k == 3 else "") for k, at in enumerate(nodes)]
    lines += [node(900, nodes[13]), "*PART", "block", card(1, 1, 1), "*ELEMENT_SOLID"]
    lines += [card(k + 1, 1, *(101 + n for n in corners)) for k, corners in enumerate(hexes)]
    a = [101 + n for n in hexes[0]]
    lines += [card(50, 2, *a[:4], a[4], a[4], a[7], a[7]), card(51, 2, a[0], a[1], a[3], *[a[4]] * 5)]
    lines += ["*ELEMENT_SHELL_THICKNESS", card(60, 3, *a[:4]), "             1.0             1.0             1.0"]
    lines += ["*ELEMENT_BEAM", card(70, 4, 101, 102, 0), "*DEFINE_BOX", card(1, -1, 1, -1, 1, -1, 1)]
    lines += ["*CONSTRAINED_JOINT_SPHERICAL", card(114, 900), "*SET_NODE_LIST", card(1), card(101, 102), "*END", "left"]
    return ending.join(lines).encode("latin-1")


def lsdyna_by_commas() -> bytes:
    """A keyword deck whose fields stand between commas."""
    lines = ["*KEYWORD", "*NODE"]
    lines += [f"{101 + k},{x!r}, {y!r},{z!r},0,0" for k, (x, y, z) in enumerate(grid_nodes().tolist())]
    lines += ["*ELEMENT_SOLID"]
    lines += [",".join(str(n) for n in (k + 1, 1, *(101 + n for n in c))) for k, c in enumerate(grid_hexes())]
    return "\n".join([*lines, "*END", ""]).encode("ascii")


def abaqus(*, ending: str = "\n", part: bool = False) -> bytes:
    """An input deck: hexahedra over two lines, shells, a truss, sets, an orientation."""
    lines = ["*Heading", "** block \xe9"]
    lines += ["*Part, name=BLOCK"] if part else []
    lines += ["*Node, nset=ALL"]
    lines += [f"{k + 1:7d}, {x!r},  {y!r}, {z!r}" for k, (x, y, z) in enumerate(grid_nodes().tolist())]
    lines += ["*Element, type=C3D8R,", "   elset=SOLID"]
    for k, corners in enumerate(grid_hexes()):
        numbers = [str(n + 1) for n in corners]
        lines += [f"{k + 1}, {', '.join(numbers[:4])},", f"   {', '.join(numbers[4:])}"]
    lines += ["*ELEMENT, TYPE=S4R, ELSET=SHELL", "101, 1, 10, 13, 4", "*Element, type=T3D2", "201, 1, 2"]
    lines += ["*Nset, nset=ENDS", "1, 2, 3", "*Orientation, name=O", "1., 0., 0., 0., 1., 0."]
    if part:
        lines += ["*End Part", "*Assembly, name=A", "*Instance, name=BLOCK-1, part=BLOCK", "*End Instance"]
        lines += ["*End Assembly"]
    lines += ["*Step", "*Static", "0.1, 1.", "*Node Print", "U", "*End Step", ""]
    return ending.join(lines).encode("latin-1")


def febio(*, ending: str = "\n", version: str = "4.0") -> bytes:
    """A FEBio file: hexahedra, a surface of nodes, fibres, a comment and blanks among the nodes."""
    mesh = "Mesh" if float(version) >= 3 else "Geometry"
    lines = ['<?xml version="1.0" encoding="ISO-8859-1"?>', f'<febio_spec version="{version}">']
    lines += ['\t<!-- <node id="1">0,0,0</node> \xe9 -->', f"\t<{mesh}>", '\t\t<Nodes name="block">']
    lines += [
        f'\t\t\t<node id="{k + 1}"> {x!r}, {y!r},{z!r}</node>' for k, (x, y, z) in enumerate(grid_nodes().tolist())
    ]
    lines += ["\t\t</Nodes>", '\t\t<Elements type="hex8" name="solid">']
    lines += [f'\t\t\t<elem id="{k + 1}">{",".join(str(n + 1) for n in c)}</elem>' for k, c in enumerate(grid_hexes())]
    lines += ["\t\t</Elements>", '\t\t<NodeSet name="ends"><node id="1"/><node id="2"/></NodeSet>', f"\t</{mesh}>"]
    lines += [
        '\t<MeshData><ElementData var="fiber" elem_set="solid"><elem lid="1">1,0,0</elem></ElementData></MeshData>'
    ]
    lines += ["</febio_spec>", ""]
    return ending.join(lines).encode("latin-1")

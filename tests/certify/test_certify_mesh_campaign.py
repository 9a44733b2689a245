"""A small part of the campaign of meshes; the whole of it is ``python tests/mesh_campaign.py --cases 10000``."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_campaign import campaign, case, edge_meets, meet, share_volume, volume, whole, wrong
from tet_blocks import block

from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.vocabulary import Claim


def test_no_claim_of_a_small_campaign_is_wrong() -> None:
    claims, faults = campaign(range(60))
    assert faults == []
    assert claims[Claim.CERTIFIED.value] >= 20
    assert claims[Claim.REFUTED.value] >= 10


def test_the_campaign_sees_forged_claims(monkeypatch: pytest.MonkeyPatch) -> None:
    """Meshes with crossings, judged as if the block at rest stood in their place."""
    import mesh_campaign

    certify = mesh_campaign.certify_mesh
    monkeypatch.setattr(mesh_campaign, "certify_mesh", lambda _: certify(block((1, 1, 1))))
    faults = [wrong(case(seed))[1] for seed in range(30)]
    assert sum(bool(fault) for fault in faults) >= 5


def test_the_oracle_knows_contact_from_overlap() -> None:
    corner = ((0, 0, 0), (4, 0, 0), (0, 4, 0))
    assert meet(corner, ((1, 1, 0), (1, 1, 5), (2, 2, 5)))  # a vertex on the other
    assert not meet(corner, ((1, 1, 1), (1, 1, 5), (2, 2, 5)))
    assert not meet(corner, ((0, 0, 0), (-4, 1, 3), (-4, -1, 3)))  # a common corner alone
    assert meet(corner, ((0, 0, 0), (4, 0, 0), (1, 1, 0)))  # folded onto each other
    assert not meet(corner, ((0, 0, 0), (4, 0, 0), (1, -1, 0)))
    assert edge_meets((1, 1, -1), (1, 1, 1), corner, [])
    tet = [(0, 0, 0), (2, 0, 0), (0, 2, 0), (0, 0, 2)]
    assert volume(*tet) == 8
    assert not share_volume(tet, [(x + 2, y, z) for x, y, z in tet])
    assert share_volume(tet, [(x + 1, y, z) for x, y, z in tet])
    assert whole(np.array([[0.5, 0.25, 1.0]])) == [(2, 1, 4)]


def test_an_ulp_off_a_neighbours_plane_is_no_crossing() -> None:
    """Two triangles with one common corner; one of them stays below the other's plane by the last bit."""
    high = 53.98204456172701
    below = np.nextafter(high, 0.0)
    vertices = np.array(
        [
            [15.624434031123023, 28.61804790698585, below],
            [0.0, 0.0, high],
            [0.0, high, 0.0],
            [0.0, high, high],
            [high, high, high],
        ]
    )
    assert len(self_crossings(TriMesh(vertices, np.array([[0, 3, 2], [3, 1, 4]])))) == 0
    vertices[0, 2] = np.nextafter(high, 100.0)  # through it
    assert len(self_crossings(TriMesh(vertices, np.array([[0, 3, 2], [3, 1, 4]])))) == 1

"""Fibres of muscles put into the tetrahedra of a run: each takes the direction of the nearest place that has one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from musclefit.errors import InputError
from musclefit.geometry.arrays import Int, Points
from musclefit.io.formats.fibre_directions import MuscleFibres
from musclefit.io.formats.solvers import LabelledTets
from musclefit.io.run_folder import file_names

OTHER_POSE = 2.0
"""Fibres are of another pose than the tetrahedra where they lie so many times as far off them as at rest, and `APART`
more, in the median of a muscle."""

APART_MM = 1.0


def fibres_at_rest(rest: LabelledTets, fibres: Mapping[str, MuscleFibres]) -> tuple[Points, Mapping[str, float]]:
    """Directions for a run's tetrahedra at rest.

    Parameters
    ----------
    rest : LabelledTets
    fibres : mapping of muscle to MuscleFibres

    Returns
    -------
    (k, 3) directions of length 1, 0 where a tet has none; and for each tissue that has fibres how far the middle of one
    of its tets is, at most, from the place whose direction it takes, mm

    Raises
    ------
    InputError
        None of the tetrahedra's tissues has fibres.
    """
    along, off = np.zeros((len(rest.tets), 3)), {}
    for name, own, one in _muscles(rest, fibres):
        distances, nearest = cKDTree(one.places).query(rest.vertices[rest.tets[own]].mean(axis=1))
        along[own], off[name] = one.directions[nearest], float(np.max(distances))
    return along, off


def fibres_carried(rest: LabelledTets, posed: LabelledTets, fibres: Mapping[str, MuscleFibres]) -> Points:
    """(k, 3) directions for a run's tetrahedra in its pose: F f of the map, whose length is the fibre's stretch.

    Parameters
    ----------
    rest, posed : LabelledTets
        The same tetrahedra.
    fibres : mapping of muscle to MuscleFibres

    Raises
    ------
    InputError
        None of the tetrahedra's tissues has fibres, they were not carried, or into another pose.
    """
    along = np.zeros((len(rest.tets), 3))
    for name, own, one in _muscles(rest, fibres):
        if one.moved is None or one.carried is None:
            raise InputError(
                f"{name}: its fibres are known at rest alone; run musclefit architecture without --rest, or take the "
                "shape at rest"
            )
        before, nearest = cKDTree(one.places).query(rest.vertices[rest.tets[own]].mean(axis=1))
        after = np.linalg.norm(one.moved[nearest] - posed.vertices[posed.tets[own]].mean(axis=1), axis=1)
        if np.median(after) > OTHER_POSE * np.median(before) + APART_MM:
            raise InputError(
                f"{name}: its fibres were carried into another pose than the run's: they lie {np.median(after):.3g} mm "
                f"off its tetrahedra in the median, at rest {np.median(before):.3g} mm; make both with the same rig"
            )
        along[own] = one.carried[nearest]
    return along


def by_tissue(fibres: Mapping[str, MuscleFibres]) -> Mapping[str, MuscleFibres]:
    """Each muscle's fibres by its own name and by the one that a run's tetrahedra have it under."""
    safe = file_names([*fibres])
    return {safe[name]: one for name, one in fibres.items()} | dict(fibres)


def _muscles(rest: LabelledTets, fibres: Mapping[str, MuscleFibres]) -> list[tuple[str, Int, MuscleFibres]]:
    """Name, tets and fibres of each tissue that has any."""
    known = by_tissue(fibres)
    found: list[tuple[str, Int, MuscleFibres]] = [
        (rest.names[number], np.flatnonzero(rest.tissue_of_tet == number), known[rest.names[number]])
        for number in np.unique(rest.tissue_of_tet)
        if rest.names[number] in known and len(known[rest.names[number]].places)
    ]
    if not found:
        raise InputError(
            f"no tissue of the tetrahedra has fibres: they are {', '.join(rest.names)}; fibres are known of "
            f"{', '.join(fibres) or 'none'}"
        )
    return found

"""One colour per tissue, the same in every panel; knows names and kinds, not meshes."""

from __future__ import annotations

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind

Colour = tuple[float, float, float]

SKIN: Colour = (0.91, 0.72, 0.60)
BONE: Colour = (0.97, 0.94, 0.86)
FOLD: Colour = (0.85, 0.00, 0.95)
"""Where the map folds: nothing in a body is magenta."""
OVERLAP: Colour = (0.00, 0.35, 1.00)
"""Where tissues overlap: nothing in a body is blue."""

_REDS = np.array([[0.40, 0.07, 0.09], [0.62, 0.13, 0.14], [0.78, 0.26, 0.24], [0.88, 0.46, 0.40], [0.94, 0.63, 0.55]])
_OCHRES = np.array([[0.72, 0.56, 0.24], [0.90, 0.78, 0.46]])
_GOLDEN = 0.6180339887498949


def tissue_colours(anatomy: Anatomy) -> dict[str, Colour]:
    """A colour for each tissue by name: skin, ivory bones, a red of its own for each muscle, ochres for the rest.

    Neighbours in the list of names are far apart in shade (golden section): they are often neighbours in the body.
    """
    colours: dict[str, Colour] = {}
    for kind, ramp in ((TissueKind.MUSCLE, _REDS), (TissueKind.OTHER, _OCHRES)):
        for i, tissue in enumerate(anatomy.of_kind(kind)):
            colours[tissue.name] = _along(ramp, (0.5 + i * _GOLDEN) % 1.0)
    colours |= {tissue.name: BONE for tissue in anatomy.of_kind(TissueKind.BONE)}
    colours |= {tissue.name: SKIN for tissue in anatomy.of_kind(TissueKind.SKIN)}
    return colours


def _along(ramp: np.ndarray[tuple[int, ...], np.dtype[np.float64]], share: float) -> Colour:
    at = share * (len(ramp) - 1)
    red, green, blue = (float(np.interp(at, np.arange(len(ramp)), ramp[:, k])) for k in range(3))
    return red, green, blue

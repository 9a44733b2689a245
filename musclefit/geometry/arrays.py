"""Array types by meaning, and the one place where arrays are made read-only."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float: TypeAlias = NDArray[np.float64]
Int: TypeAlias = NDArray[np.int64]
Bool: TypeAlias = NDArray[np.bool_]

Points: TypeAlias = Float
"""(N, n) positions, mm; n = 2 or 3."""
Gradients: TypeAlias = Float
"""(N, n, n) derivatives; entry [p, i, k] is the derivative of component i along axis k at point p."""
Faces: TypeAlias = Int
"""(f, 3) vertex indices, counter-clockwise seen from outside."""
Tets: TypeAlias = Int
"""(k, 4) vertex indices, right-handed: det[v1-v0, v2-v0, v3-v0] > 0."""


def frozen(values: ArrayLike, dtype: type[Any] = np.float64) -> NDArray[Any]:
    """A read-only, C-contiguous copy (or the same array when it is all that already)."""
    array = np.ascontiguousarray(values, dtype=dtype)
    if array.flags.writeable:
        array = array.copy() if array is values or array.base is not None else array
        array.flags.writeable = False
    return array

"""Fig. 9 of Yu et al. 2014: a real leg through a jump and its landing, with the muscles' measures over time.

    MUSCLEFIT_DATA=... python examples/fig9_jump.py --out musclefit-out/fig9

The same 20 landmarks in one shot, by the paper's loop, and by the rig's own method, every frame from rest, so that the
last frame is the first. A run that was interrupted goes on.
"""

from __future__ import annotations

from fig8_forearm_motion import compare

if __name__ == "__main__":
    compare("leg_jump", figure="fig9", at=(0.16, 0.28, 0.44, 0.72))

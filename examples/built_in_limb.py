# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     name: python3
# ---
# %% [markdown]
# # From the built-in limb to a checked pose
#
# Open this file as a notebook (Jupyter with jupytext, VS Code, PyCharm), or run it: `python examples/built_in_limb.py`.
# It needs no data. Data frames need the extra `notebook`.

# %%
import tempfile
from pathlib import Path

import numpy as np

import musclefit as mf

out = Path(tempfile.mkdtemp()) / "limb"

# %% [markdown]
# ## How far can the joints turn?
# Both ways from rest, until bones collide or a limit is reached.

# %%
ranges = mf.joint_range("upper_limb")
print(ranges)

# %% [markdown]
# ## A pose, by the paper's loop
# It is quick, and made of landmarks only: bones bend and muscles change, and the report says so. Leave out the method,
# and bones stay rigid and muscles at their volume; that takes a minute. Without `tets=False` the limb is filled with
# tetrahedra too, which takes half a minute the first time.

# %%
loop = ["drive.pose.elbow_deg=45", "deformer.method=yu2014"]
done = mf.run("upper_limb", out=out, overrides=loop, tets=False, pictures=False)
print(done)

# %% [markdown]
# ## What was checked
# Every check has a limit, and one that fails says what to do next.

# %%
for check in done.report.checks:
    print("ok  " if check.passed else "FAIL", f"{check.name}: {check.value:.4g} {check.unit}")
    if not check.passed:
        print("     ", check.next_step)

# %%
tables = done.to_frames()
print(tables["tissues"][["name", "kind", "volume_change_percent", "rigidity_mm"]].round(3).to_string(index=False))

# %% [markdown]
# ## The map is a value
# It takes any points, gives derivatives, and has an inverse.

# %%
points = done.rest.vertices()[::500]
moved = done.deformation(points)
back = done.deformation.inverse()(moved)
determinants = np.linalg.det(done.deformation.jacobian(points))
print(f"there and back within {np.abs(back - points).max():.1e} mm; det J from {determinants.min():.2f} to "
      f"{determinants.max():.2f}")  # fmt: skip

# %% [markdown]
# ## Look at it
# `done.plot().show()` opens a window, or a view in a notebook; `report.html` in the folder has it all.

# %%
print(sorted(path.name for path in out.iterdir()))

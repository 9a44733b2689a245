"""Pictures by pyvista: returned unshown."""

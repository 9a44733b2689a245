"""From handles and their displacements to a field: linear systems and least squares."""

"""File formats: one module each, from bytes to arrays or back; they know no anatomy."""

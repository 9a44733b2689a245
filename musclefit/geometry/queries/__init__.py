"""Questions to surfaces: distances, gaps, what is inside, what two solids share."""

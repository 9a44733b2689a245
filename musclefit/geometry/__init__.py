"""Arrays in, arrays out: what would be true of any mesh."""

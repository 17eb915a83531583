"""A map bounded by its area: what was measured during visits to a place is condensed to one edge."""

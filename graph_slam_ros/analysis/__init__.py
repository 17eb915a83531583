"""What a run is worth and why: errors against truth, consistency, what is believed and what would change."""

"""Analysis of a run: errors against truth, consistency, what is believed and what would change."""

"""The weakest directions of a map, and what one more measurement would gain."""

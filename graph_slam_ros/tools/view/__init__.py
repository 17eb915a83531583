"""The page of a run, served on the loopback: what-if is solved, edits are tried and saved as another run."""

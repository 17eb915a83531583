"""The sparse solver: ordering, symbolic and numeric elimination on a clique tree updated in place."""

"""Robust estimation: gating, pairwise consistency, alternative hypotheses, displacement, the ledger."""

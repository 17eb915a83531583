"""What is believed: gating, pairwise consistency, alternative hypotheses, displacement, the ledger."""

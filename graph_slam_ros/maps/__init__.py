"""Maps of several runs: aligned, compared, merged, exported."""

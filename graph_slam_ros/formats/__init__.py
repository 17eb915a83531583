"""File syntax: g2o, TUM, the ingest sequence. The only place that knows it."""

"""File syntax: g2o, TUM, the bytes of a message. The only place that knows it."""

"""Calibration: what drivers and rulers got slightly wrong, estimated with the map."""

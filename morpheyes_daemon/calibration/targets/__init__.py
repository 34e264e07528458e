"""Calibration boards in images: finding them, refining corners, pairing pictures, coverage."""

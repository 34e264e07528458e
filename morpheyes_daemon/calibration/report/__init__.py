"""The HTML report of a calibration and its figures."""

"""The stereo camera twin: true rig, sensor, calibration boards."""

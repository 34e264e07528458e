"""From a stereo frame to depth and percept, with the monitors that run in flight."""

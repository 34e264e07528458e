"""From board observations to a calibrated rig with its uncertainty and its acceptance."""

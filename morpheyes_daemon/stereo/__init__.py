"""Pure stereo geometry: rig model, rectification, matching, depth with its uncertainty."""

"""The concurrent loops: wait, step, publish."""

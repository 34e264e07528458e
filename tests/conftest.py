"""Hypothesis: the same examples on every run, and no deadline, since a busy machine is no bug."""

from hypothesis import settings

settings.register_profile("morpheyes", deadline=None, derandomize=True)
settings.load_profile("morpheyes")

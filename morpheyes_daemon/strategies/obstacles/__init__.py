"""Obstacles in a depth map: polar profile, corridor, ground slope."""

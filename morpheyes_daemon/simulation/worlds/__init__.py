"""Worlds: loader, forest, gap and room, trajectories, collision."""

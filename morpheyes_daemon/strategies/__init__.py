"""Missions as strategies: what to make of an image, and where to fly."""

"""Missions as strategies: perception of a frame, and the decision where to fly."""

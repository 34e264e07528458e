"""Owns every task, watches every age, decides the state."""

"""The gap mission: find an opening in a wall and cross it."""

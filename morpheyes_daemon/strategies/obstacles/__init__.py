"""What a depth map says about obstacles: polar profile, corridor, ground slope."""

"""The moving-object mission: detects and tracks an independently moving object in 3D; observes, pursues or dodges it."""

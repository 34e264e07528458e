"""The mission that finds an independently moving object, tells where it is in 3D, and watches, pursues or dodges it."""

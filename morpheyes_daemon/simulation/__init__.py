"""The twins: world and cameras, vehicle and autopilot, Teensy."""

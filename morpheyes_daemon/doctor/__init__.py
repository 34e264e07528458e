"""Preflight: is this vehicle fit to fly, what stands against it, and what exactly remedies it."""

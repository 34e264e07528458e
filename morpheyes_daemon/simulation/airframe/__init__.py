"""The vehicle's body: dynamics, wind."""

"""The ground crew of simulated and SITL flights: arm, take off, switch, land."""

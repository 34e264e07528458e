"""Pure control: PID, baseline law, speed governor, velocity to sticks."""

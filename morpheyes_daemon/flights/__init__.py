"""One simulated flight: plan, lockstep or real time or SITL, referee, artifacts."""

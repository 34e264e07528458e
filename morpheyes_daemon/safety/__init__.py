"""The state machine and the gate that has the last word on sticks."""

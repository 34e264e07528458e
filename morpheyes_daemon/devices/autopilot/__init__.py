"""The autopilot link: one owner of the port, telemetry in, overrides out."""

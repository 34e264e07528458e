"""The autopilot twin: ArduCopter's modes, EKF, RC input and MAVLink telemetry."""

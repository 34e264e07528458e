"""Bytes to messages and back, for the servo and for MAVLink."""

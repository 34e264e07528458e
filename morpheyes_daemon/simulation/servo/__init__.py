"""The Teensy twin and its pseudo-terminal."""

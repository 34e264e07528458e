"""What topics and events carry: frozen dataclasses and reason codes."""

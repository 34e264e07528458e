"""The only place that opens ports and cameras."""

"""The daemon put together: composition, task table, service, systemd."""

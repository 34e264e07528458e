"""`morpheyes calibrate`: offline, live and mount commands."""

from morpheyes_daemon.cli.calibrate.offline import app

__all__ = ["app"]

"""`morpheyes bench`: speed and accuracy, measured."""

from morpheyes_daemon.cli.bench.speed import app

__all__ = ["app"]

"""Checks for optional packages, so that their absence is reported in one sentence."""

from __future__ import annotations

from importlib.util import find_spec

from morpheyes_daemon.errors import UsageError


def require_simulator() -> None:
    """Raise UsageError when the packages of the `sim` extra are missing."""
    missing = [name for name in ("av", "joblib", "numba") if find_spec(name) is None]
    if missing:
        raise UsageError(
            f"the simulator needs {', '.join(missing)}; install it with: pip install 'morpheyes-daemon[sim]'."
        )


def require_figures() -> None:
    """Raise UsageError when Mitsuba, the `figures` extra, is missing."""
    if find_spec("mitsuba") is None:
        raise UsageError("path tracing needs mitsuba; install it with: pip install 'morpheyes-daemon[figures]'.")

"""One tree of errors; each message is a sentence that says what is wrong and what to do.

The command line prints the message alone and exits with `exit_code`.
"""

import re
import sysconfig
import traceback
from pathlib import Path


class MorphEyesError(Exception):
    """Anything a person can do something about."""

    exit_code = 1


class UsageError(MorphEyesError):
    """Wrong arguments on the command line."""

    exit_code = 2


class ConfigError(MorphEyesError):
    """A configuration, mission or world file says something that cannot be."""

    exit_code = 2


class InputError(MorphEyesError):
    """An image, folder or log handed to a command cannot be used."""

    exit_code = 2


class CalibrationError(MorphEyesError):
    """A calibration is missing, damaged, or does not cover what is asked of it."""

    exit_code = 2


class RecordingError(MorphEyesError):
    """A flight log cannot be written or read."""


class DeviceError(MorphEyesError):
    """A camera, servo or autopilot link does not work."""


class DeviceNotFoundError(DeviceError):
    """The device cannot be opened: wrong name, unplugged, or no permission."""


class DeviceLostError(DeviceError):
    """The device was open and went away."""


class DeviceTimeoutError(DeviceError):
    """The device is there but does not answer in time."""


_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """Return text from a file or a link as a terminal may show it: control characters are written out.

    An escape sequence could clear the screen, rename the window, or show another text than stands there.
    """
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text).replace("\n", "\\n")


def mistake(error: BaseException) -> str:
    """Return what an unforeseen error says, with the last line before libraries, for whoever writes a strategy."""
    libraries = "site-packages", sysconfig.get_path("stdlib")
    lines = traceback.extract_tb(error.__traceback__)
    last = ([line for line in lines if not any(path in line.filename for path in libraries)] or lines)[-1]
    return f"{type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})"

#!/usr/bin/env python3
"""Set up an environment of its own in .venv, then fly or test. Needs nothing but Python 3.11 and pip.

python3 start.py fly  [options of `morpheyes sim forest`]
python3 start.py test [options of pytest]
"""

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
EXTRAS = {"fly": "sim", "test": "dev"}


def program(name: str) -> Path:
    """Path of a program inside the environment."""
    folder, ending = ("Scripts", ".exe") if sys.platform == "win32" else ("bin", "")
    return VENV / folder / (name + ending)


def make_environment() -> None:
    """Create .venv; where Python came without ensurepip (Debian), pip is used from outside."""
    print(f"Making an environment in {VENV} ...", flush=True)
    if subprocess.run([sys.executable, "-m", "venv", VENV], capture_output=True).returncode:
        shutil.rmtree(VENV, ignore_errors=True)
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", VENV], check=True)


def install(extra: str) -> None:
    """Install the project with an extra, unless that was done with the same pyproject.toml before."""
    stamp = VENV / f"installed-{extra}"
    wanted = hashlib.sha256((ROOT / "pyproject.toml").read_bytes()).hexdigest()
    if stamp.is_file() and stamp.read_text() == wanted:
        return
    if not program("python").exists():
        make_environment()
    print(f"Installing MorphEyes with its {extra} packages; this takes a minute or two ...", flush=True)
    pip = [str(program("python")), "-m", "pip"]
    if subprocess.run([*pip, "--version"], capture_output=True).returncode:
        pip = [sys.executable, "-m", "pip", "--python", str(program("python"))]
    subprocess.run([*pip, "install", "-q", "--disable-pip-version-check", "-e", f"{ROOT}[{extra}]"], check=True)
    stamp.write_text(wanted)


def main() -> int:
    """Run the chosen command and return its exit code."""
    if len(sys.argv) < 2 or sys.argv[1] not in EXTRAS:
        print(__doc__)
        return 2
    if sys.version_info < (3, 11):
        print(f"MorphEyes needs Python 3.11 or newer; this is {sys.version.split()[0]}.")
        return 2
    what, rest = sys.argv[1], sys.argv[2:]
    try:
        install(EXTRAS[what])
    except subprocess.CalledProcessError as error:
        print(f"The set-up failed (exit code {error.returncode}); the lines above say why.")
        return 1
    if what == "fly":
        return subprocess.run([program("morpheyes"), "sim", "forest", *rest], cwd=ROOT).returncode
    return subprocess.run([program("python"), "-m", "pytest", *(rest or ["-q", "-n", "2"])], cwd=ROOT).returncode


if __name__ == "__main__":
    sys.exit(main())

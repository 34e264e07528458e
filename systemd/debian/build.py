#!/usr/bin/env python3
"""Build the Debian package: python3 systemd/debian/build.py [--out dist] [--without-libraries]

Run it with the Python of the machine that will fly (same minor version, same architecture): the libraries of
pyproject.toml are fetched by pip and packed along, so that the vehicle needs no network. `--without-libraries` packs
our own files alone. Needs dpkg-deb and pip.
"""

import argparse
import compileall
import hashlib
import py_compile
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LIBRARY = Path("usr/lib/morpheyes")
CONFFILE = Path("etc/morpheyes/config.yaml")
SYSTEM_FILES = {
    "systemd/morpheyes.service": "usr/lib/systemd/system/morpheyes.service",
    "systemd/morpheyes.sysusers": "usr/lib/sysusers.d/morpheyes.conf",
    "systemd/morpheyes.tmpfiles": "usr/lib/tmpfiles.d/morpheyes.conf",
    "systemd/70-morpheyes.rules": "usr/lib/udev/rules.d/70-morpheyes.rules",
    "config.yaml": str(CONFFILE),
    "LICENSE": "usr/share/doc/morpheyes/copyright",
}


def copy(source: Path, target: Path, mode: int = 0o644) -> None:
    """Copy one file, making its folder."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    target.chmod(mode)


def lay_out(stage: Path, *, libraries: bool) -> None:
    """Put every file where it belongs under `stage`."""
    library = stage / LIBRARY
    without = shutil.ignore_patterns("__pycache__", "debian")
    shutil.copytree(ROOT / "morpheyes_daemon", library / "morpheyes_daemon", ignore=without)
    for name in ("missions", "systemd"):
        shutil.copytree(ROOT / name, library / "morpheyes_daemon" / "shipped" / name, ignore=without)
    copy(ROOT / "config.yaml", library / "morpheyes_daemon" / "shipped" / "config.yaml")
    if libraries:
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", "--target", str(library)]
        subprocess.run([*pip, *PROJECT["dependencies"]], check=True)
        shutil.rmtree(library / "bin", ignore_errors=True)
    # Compiled here and never checked again: nothing may be written beside them later, or removal would leave it.
    compileall.compile_dir(
        library,
        stripdir=str(stage),
        prependdir="/",
        quiet=2,
        invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH,
    )
    copy(HERE / "launcher", stage / "usr/bin/morpheyes", 0o755)
    for source, target in SYSTEM_FILES.items():
        copy(ROOT / source, stage / target)
    for folder in [stage, *(path for path in stage.rglob("*") if path.is_dir())]:
        folder.chmod(0o755)


def write_control(stage: Path, *, libraries: bool) -> str:
    """Write DEBIAN/ and return the architecture."""
    files = sorted(path for path in stage.rglob("*") if path.is_file())
    control = stage / "DEBIAN"
    control.mkdir(mode=0o755)
    architecture = "all"
    if libraries:
        architecture = subprocess.run(
            ["dpkg", "--print-architecture"], check=True, capture_output=True, text=True
        ).stdout.strip()
    minor = sys.version_info.minor
    values = {
        "VERSION": PROJECT["version"],
        "ARCHITECTURE": architecture,
        "SIZE": str(sum(path.stat().st_size for path in files) // 1024),
        "DEPENDS": f"python3 (>= 3.{minor}), python3 (<< 3.{minor + 1}), systemd",
    }
    text = re.sub(r"@([A-Z]+)@", lambda found: values[found.group(1)], (HERE / "control.in").read_text())
    (control / "control").write_text(text)
    (control / "conffiles").write_text(f"/{CONFFILE}\n")
    sums = [f"{hashlib.md5(path.read_bytes()).hexdigest()}  {path.relative_to(stage)}\n" for path in files]
    (control / "md5sums").write_text("".join(sums))
    for name in ("postinst", "prerm", "postrm"):
        copy(HERE / name, control / name, 0o755)
    return architecture


def build(out: Path, *, libraries: bool) -> Path:
    """Build the package into `out` and return its path."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        stage = Path(folder) / "stage"
        stage.mkdir()
        lay_out(stage, libraries=libraries)
        architecture = write_control(stage, libraries=libraries)
        package = out / f"morpheyes_{PROJECT['version']}_{architecture}.deb"
        command = ["dpkg-deb", "--root-owner-group", "-Zzstd", "-z6", "--build", str(stage), str(package)]
        subprocess.run(command, check=True, capture_output=True)
    return package


def main() -> None:
    """Read the arguments, build, say where the package is."""
    parser = argparse.ArgumentParser(description="Build the Debian package of MorphEyes.")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder for the package")
    parser.add_argument("--without-libraries", action="store_true", help="pack our own files alone")
    arguments = parser.parse_args()
    for tool in ("dpkg-deb", "dpkg"):
        if shutil.which(tool) is None:
            parser.exit(1, f"{tool} is not installed; build the package on Debian, Ubuntu or Raspberry Pi OS.\n")
    sys.stdout.write(f"{build(arguments.out, libraries=not arguments.without_libraries)}\n")


if __name__ == "__main__":
    main()

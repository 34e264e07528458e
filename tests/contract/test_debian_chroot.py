"""The package with all its libraries in a fresh Debian: installed, run, removed, purged, nothing left behind.

Slow, and wants root, the network and debootstrap. MORPHEYES_DEBIAN_PACKAGE and MORPHEYES_DEBIAN_ROOT name a package
and a Debian root file system that are there already.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SUITES = {11: "bookworm", 13: "trixie"}
"""Debian by the minor version of its Python."""
PASSING = ("proc/", "run/", "root/", "var/lib/dpkg/", "var/cache/", "var/log/dpkg.log", "var/lib/systemd/")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(not shutil.which("debootstrap"), reason="debootstrap is not installed"),
    pytest.mark.skipif(os.geteuid() != 0, reason="chroot and mount are root's"),
    pytest.mark.skipif(sys.version_info.minor not in SUITES, reason="no Debian has this Python"),
]


def run(*command: object) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def debian(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A root file system with Debian's smallest system, python3 and systemd."""
    if "MORPHEYES_DEBIAN_ROOT" in os.environ:
        root = Path(os.environ["MORPHEYES_DEBIAN_ROOT"])
    else:
        root = tmp_path_factory.mktemp("debian")
        kind = ("--variant=minbase", "--include=python3,systemd")
        done = subprocess.run(["debootstrap", *kind, SUITES[sys.version_info.minor], str(root)], capture_output=True)
        if done.returncode != 0:
            pytest.skip("debootstrap cannot fetch Debian: no network?")
    with mounted(root / "proc"):
        yield root


@contextmanager
def mounted(folder: Path) -> Iterator[None]:
    run("mount", "-t", "proc", "proc", folder)
    try:
        yield
    finally:
        run("umount", folder)


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if "MORPHEYES_DEBIAN_PACKAGE" in os.environ:
        return Path(os.environ["MORPHEYES_DEBIAN_PACKAGE"])
    out = tmp_path_factory.mktemp("dist")
    return Path(run(sys.executable, ROOT / "systemd/debian/build.py", "--out", out).strip().splitlines()[-1])


def files(root: Path) -> set[str]:
    found = (str(Path(folder, name).relative_to(root)) for folder, _, names in os.walk(root) for name in names)
    return {name for name in found if not name.startswith(PASSING)}


def test_install_run_remove_purge(debian: Path, package: Path) -> None:
    def inside(*command: str) -> str:
        return run("chroot", debian, *command)

    before = files(debian)
    shutil.copy(package, debian / "root/morpheyes.deb")
    inside("dpkg", "-i", "/root/morpheyes.deb")
    installed = files(debian)
    assert inside("morpheyes", "--version").strip().count(".") == 2
    assert "good" in inside("morpheyes", "config", "check", "/etc/morpheyes/config.yaml")
    inside("systemd-analyze", "verify", "/usr/lib/systemd/system/morpheyes.service")
    assert inside("stat", "-c", "%U", "/var/lib/morpheyes", "/var/log/morpheyes").split() == ["morpheyes"] * 2
    assert files(debian) == installed, "running it leaves nothing beside it"

    (debian / "var/log/morpheyes/flight.mcap").touch()
    inside("dpkg", "--remove", "morpheyes")
    assert files(debian) - before - users() == {"etc/morpheyes/config.yaml", "var/log/morpheyes/flight.mcap"}
    inside("dpkg", "--purge", "morpheyes")
    assert files(debian) - before - users() == set()
    assert before <= files(debian)


def users() -> set[str]:
    """What makes the system user, who stays: files may be his."""
    return {f"etc/{name}{end}" for name in ("passwd", "group", "shadow", "gshadow", ".pwd.lock") for end in ("", "-")}

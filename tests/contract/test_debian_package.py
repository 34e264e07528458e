"""The Debian package puts everything in place in a clean root, and takes it away again."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
OWN = {
    "usr/bin/morpheyes",
    "usr/lib/systemd/system/morpheyes.service",
    "usr/lib/sysusers.d/morpheyes.conf",
    "usr/lib/tmpfiles.d/morpheyes.conf",
    "usr/lib/udev/rules.d/70-morpheyes.rules",
    "etc/morpheyes/config.yaml",
    "usr/lib/morpheyes/morpheyes_daemon/shipped/missions/forest.yaml",
}

pytestmark = [
    pytest.mark.skipif(not shutil.which("dpkg-deb"), reason="dpkg is not installed"),
    pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() != 0, reason="dpkg installs as root only"),
]


def run(*command: object, **more: Any) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=120, **more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package with our own files; its libraries are only fetched for a real one."""
    out = tmp_path_factory.mktemp("dist")
    return Path(run(sys.executable, ROOT / "systemd/debian/build.py", "--out", out, "--without-libraries").strip())


@pytest.fixture
def clean_root(tmp_path: Path) -> Path:
    """A root file system with nothing but dpkg's own records."""
    root = tmp_path / "root"
    for folder in ("etc", "var/lib/dpkg/info", "var/lib/dpkg/updates", "var/lib/dpkg/triggers", "usr"):
        (root / folder).mkdir(parents=True)
    (root / "var/lib/dpkg/status").touch()
    return root


def dpkg(root: Path, *arguments: object) -> str:
    alone = ("--force-script-chrootless", "--force-depends", "--log=/dev/null")
    path = f"{os.environ['PATH']}:/usr/local/sbin:/usr/sbin:/sbin"  # where dpkg looks for programs of its own
    return run("dpkg", f"--root={root}", *alone, *arguments, env={**os.environ, "PATH": path})


def files(root: Path) -> set[str]:
    found = (path.relative_to(root) for path in root.rglob("*") if path.is_file() or path.is_symlink())
    return {str(path) for path in found if path.parts[:3] != ("var", "lib", "dpkg")}


def test_control_names_the_python_it_was_made_for(package: Path) -> None:
    control = run("dpkg-deb", "--field", package)
    minor = sys.version_info.minor
    assert f"python3 (>= 3.{minor}), python3 (<< 3.{minor + 1})" in control
    assert "@" not in re.sub(r"<[^>]*>", "", control)


def test_everything_belongs_to_root_and_only_the_command_is_executable(package: Path) -> None:
    listing = run("dpkg-deb", "--contents", package).splitlines()
    assert {line.split()[1] for line in listing} == {"root/root"}
    executable = {line.split()[-1] for line in listing if line.startswith("-rwx")}
    assert executable == {"./usr/bin/morpheyes"}
    assert not [line for line in listing if "/debian/" in line or line.endswith(".nbc")]


def test_install_remove_purge_in_a_clean_root(package: Path, clean_root: Path) -> None:
    dpkg(clean_root, "--install", package)
    assert files(clean_root) >= OWN
    assert "morpheyes:" in (clean_root / "etc/passwd").read_text()
    assert (clean_root / "var/lib/morpheyes/calibration").is_dir()
    assert not (clean_root / "etc/systemd").exists()  # installed, not enabled: nobody has checked this vehicle yet

    (clean_root / "var/log/morpheyes/flight.mcap").write_text("a flight")
    dpkg(clean_root, "--remove", "morpheyes")
    left = files(clean_root) - {"etc/passwd", "etc/group", "etc/shadow", "etc/gshadow", "etc/.pwd.lock"}
    assert left == {"etc/morpheyes/config.yaml", "var/log/morpheyes/flight.mcap"}

    dpkg(clean_root, "--purge", "morpheyes")
    left = files(clean_root) - {"etc/passwd", "etc/group", "etc/shadow", "etc/gshadow", "etc/.pwd.lock"}
    assert left == set()
    assert not (clean_root / "usr/lib/morpheyes").exists()


def test_the_installed_command_runs_and_leaves_nothing_behind(package: Path, clean_root: Path) -> None:
    dpkg(clean_root, "--install", package)
    before = files(clean_root)
    command = clean_root / "usr/bin/morpheyes"
    out = run(sys.executable, command, "--version", cwd="/")
    assert re.fullmatch(r"\d+\.\d+\.\d+", out.strip())
    run(sys.executable, command, "config", "check", clean_root / "etc/morpheyes/config.yaml", cwd="/")
    assert files(clean_root) == before


def test_an_upgrade_keeps_a_changed_configuration(package: Path, clean_root: Path) -> None:
    dpkg(clean_root, "--install", package)
    config = clean_root / "etc/morpheyes/config.yaml"
    config.write_text("# mine\n" + config.read_text())
    dpkg(clean_root, "--force-confold", "--install", package)
    assert config.read_text().startswith("# mine\n")

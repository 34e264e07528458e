"""The sketch's own protocol lines, compiled on the host, agree with the daemon's byte for byte."""

from __future__ import annotations

import random
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from morpheyes_daemon.wire.servo import (
    VERSION,
    Ack,
    Decoder,
    Hello,
    Message,
    SetTarget,
    Status,
    StatusFlag,
    Verdict,
    Welcome,
    cobs_decode,
    decode_body,
    encode,
)
from tests.unit.wire.test_servo_wire import GOLDEN

ROOT = Path(__file__).parents[2]
SKETCH = ROOT / "firmware" / "morpheyes_servo"
Firmware = Callable[[list[str]], list[str]]


def compiled(source: str, language: str, folder: Path) -> Firmware:
    """Compile a harness, memory errors fatal where the compiler can; returns a function from lines to lines."""
    names = {"c": ("cc", "gcc", "clang"), "c++": ("c++", "g++", "clang++")}[language]
    compiler = next((path for path in map(shutil.which, names) if path), None)
    if compiler is None:
        pytest.skip(f"no {language} compiler ({', '.join(names)}) on this machine")
    program = folder / source.partition(".")[0]
    path = Path(__file__).with_name(source)
    build = [compiler, "-Wall", "-Wextra", "-Werror", "-O1", str(path), "-o", str(program)]
    sanitizer = ["-fsanitize=address,undefined", "-fno-sanitize-recover"]
    if subprocess.run([*build, *sanitizer], capture_output=True).returncode != 0:
        subprocess.run(build, check=True)

    def run(lines: list[str]) -> list[str]:
        done = subprocess.run([program], input="\n".join(lines) + "\n", capture_output=True, text=True, check=True)
        return done.stdout.split("\n")[:-1]

    return run


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Firmware:
    return compiled("protocol_harness.c", "c", tmp_path_factory.mktemp("firmware"))


@pytest.fixture(scope="module")
def sketch(tmp_path_factory: pytest.TempPathFactory) -> Firmware:
    return compiled("sketch_harness.cpp", "c++", tmp_path_factory.mktemp("firmware"))


@pytest.mark.parametrize(("message", "frame"), GOLDEN)
def test_golden_frames_both_ways(firmware: Firmware, message: Message, frame: str) -> None:
    body = cobs_decode(bytes.fromhex(frame)[:-1])[:-2].hex()
    assert firmware([f"frame {frame}", f"body {body}"]) == [f"body {body}", "dropped 0", f"frame {frame}"]


def test_noise_with_frames_in_it_is_read_alike(firmware: Firmware) -> None:
    noise = random.Random(7)
    frames = [encode(message) for message, _ in GOLDEN]
    stream = b"".join(
        noise.choice(frames) if noise.random() < 0.3 else noise.randbytes(noise.randrange(30)) for _ in range(10_000)
    )
    assert len(stream) > 100_000
    portions = [stream[i : i + 200_000] for i in range(0, len(stream), 200_000)]
    lines = firmware([f"frame {portion.hex()}" for portion in portions])
    bodies = [bytes.fromhex(line.removeprefix("body ")) for line in lines if line.startswith("body ")]
    decoder = Decoder()
    assert [decode_body(body) for body in bodies] == decoder.feed(stream)
    assert int(lines[-1].removeprefix("dropped ")) == decoder.dropped_frames


def told(lines: list[str]) -> list[Message]:
    """Return the messages that the sketch sent."""
    return Decoder().feed(b"".join(bytes.fromhex(line[5:]) for line in lines if line.startswith("sent ")))


def pulses_us(lines: list[str]) -> list[float]:
    """Return the pulse widths that the sketch set, in microseconds, both pins in turn."""
    return [int(line.split()[2]) / 65536 / 50 * 1e6 for line in lines if line.startswith("pulse ")]


def says(message: Message) -> str:
    return f"bytes {encode(message).hex()}"


def test_the_sketch_is_silent_on_its_pins_until_the_first_target(sketch: Firmware) -> None:
    lines = sketch(["ms 450", says(Hello())])
    assert pulses_us(lines) == []
    assert told(lines) == [
        Status(200, None, StatusFlag.COLD, 0),
        Status(400, None, StatusFlag.COLD, 0),
        Welcome(VERSION, 1, 0.1, 0.3),
    ]


def test_the_sketch_moves_both_servos_from_one_to_two_milliseconds(sketch: Firmware) -> None:
    lines = sketch([says(SetTarget(n, target_m)) for n, target_m in enumerate((0.1, 0.2, 0.3, 0.3))])
    assert pulses_us(lines) == pytest.approx([1000, 1000, 1500, 1500, 2000, 2000], abs=0.16)  # half a timer step
    assert told(lines) == [Ack(n, Verdict.APPLIED, m) for n, m in enumerate((0.1, 0.2, 0.3, 0.3))]


def test_the_sketch_keeps_within_the_stroke_and_says_so(sketch: Firmware) -> None:
    lines = sketch([says(SetTarget(1, 0.05)), says(SetTarget(2, 0.4))])
    assert pulses_us(lines) == pytest.approx([1000, 1000, 2000, 2000], abs=0.16)
    assert told(lines) == [Ack(1, Verdict.CLAMPED, 0.1), Ack(2, Verdict.CLAMPED, 0.3)]


def test_the_sketch_holds_its_target_when_the_host_falls_silent(sketch: Firmware) -> None:
    lines = sketch(["ms 100", says(SetTarget(1, 0.2)), "ms 1400", "bytes 0102ff00", "ms 100"])
    assert len(pulses_us(lines)) == 2
    *_, last = told(lines)
    assert last == Status(1600, 0.2, StatusFlag.HOST_SILENT, 1)


def test_the_sketch_is_a_page() -> None:
    lines = (SKETCH / "morpheyes_servo.ino").read_text().splitlines()
    assert len(lines) <= 80
    assert max(map(len, lines)) <= 120

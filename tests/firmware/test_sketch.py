"""The unmodified firmware folder compiled by arduino-builder, as the Arduino IDE 1.8.19 of Debian 12 does."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

FIRMWARE = Path(__file__).parents[2] / "firmware"
CORE, BUILDER = Path("/usr/share/arduino/hardware/arduino/avr"), Path("/usr/share/arduino-builder")
# firmware/README.md gives both to the user of the IDE.
BOARD = "arduino:avr:mega:cpu=atmega2560"
DEFINE = "-DDECIMAL_DIG=__DECIMAL_DIG__"


@pytest.fixture
def ide(tmp_path):
    """Copies of the IDE's core and of the folder, without compiled files."""
    if shutil.which("arduino-builder") is None or not CORE.is_dir() or shutil.which("avr-gcc") is None:
        pytest.skip("no Arduino IDE: apt-get install arduino-builder arduino-core-avr gcc-avr")
    shutil.copytree(FIRMWARE, tmp_path / "firmware")
    (tmp_path / "out").mkdir()
    for name in ("cores", "variants", "libraries", "boards.txt", "platform.txt"):
        there = tmp_path / "hardware/arduino/avr" / name
        there.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (CORE / name).is_dir() else shutil.copy)(CORE / name, there)
    return tmp_path


def compile_sketch(ide):
    """Compile the folder; return exit code and output."""
    command = ["arduino-builder", "-compile", "-hardware", ide / "hardware", "-hardware", BUILDER, "-tools", BUILDER]
    command += [
        "-fqbn",
        BOARD,
        "-build-path",
        ide / "out",
        "-prefs=runtime.tools.avr-gcc.path=/usr",
        "-warnings",
        "all",
    ]
    run = subprocess.run([*command, ide / "firmware/firmware.ino"], capture_output=True, text=True, check=False)
    return run.returncode, run.stdout + run.stderr


def test_sketch_compiles_in_arduino_ide(ide):
    (ide / "hardware/arduino/avr/platform.local.txt").write_text(f"compiler.cpp.extra_flags={DEFINE}\n")
    code, output = compile_sketch(ide)
    assert code == 0, output
    flash, ram = (int(re.search(pattern, output)[1]) for pattern in (r"uses (\d+) bytes", r"variables use (\d+) bytes"))
    assert 4000 < flash < 16_000
    assert 400 < ram < 4096  # the stack needs the rest of the 8192
    assert "/firmware/" not in output  # no warning about our files


def test_readme_names_board_and_definition():
    readme = (FIRMWARE / "README.md").read_text()
    assert BOARD in readme
    assert DEFINE in readme

"""The build of the firmware: for the MEGA, without hardware in its logic, and not with wrong limits."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
VARIANT = Path("/usr/share/arduino/hardware/arduino/avr/variants/mega/pins_arduino.h")


def test_builds_for_mega_and_is_small():
    if shutil.which("avr-gcc") is None or not VARIANT.exists():
        pytest.skip("needs Debian packages gcc-avr avr-libc arduino-core-avr")
    done = subprocess.run(["make", "-C", str(FIRMWARE)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    elf = FIRMWARE.parent / "build" / "firmware" / "modsoft.elf"
    size = subprocess.run(["avr-size", str(elf)], capture_output=True, text=True, check=True).stdout.split()
    text, data, bss = map(int, size[6:9])
    assert text + data < 16_000
    assert data + bss < 2_000  # of 8 KiB; the rest is for the stack


@pytest.mark.skipif(shutil.which("gcc") is None or shutil.which("make") is None, reason="needs gcc and make")
def test_builds_in_folder_of_any_name(tmp_path):
    root = tmp_path / "My (d)rive's & x : $HOME %"
    for part in ("firmware", "tests/firmware", "tools/fuzz"):
        shutil.copytree(FIRMWARE.parent / part, root / part)
    command = ["make", "-C", str(root / "firmware"), "../build/firmware/libslew.so"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (root / "build" / "firmware" / "libslew.so").is_file()


@pytest.mark.parametrize("setting", ["OUT=/tmp/My Drive", "ARDUINO=/tmp/a:b"])
def test_path_that_make_does_not_accept_is_refused_in_one_line(setting):
    command = ["make", "-C", str(FIRMWARE), "--no-print-directory", setting]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert f"{setting}: make takes no path with spaces or colons" in done.stderr


@pytest.mark.parametrize("name", ["frame.c", "output.c", "supervisor.c"])
def test_logic_includes_no_hardware(name):
    includes = re.findall(r"#include\s+([<\"].*?[>\"])", (FIRMWARE / name).read_text())
    allowed = {"<stdbool.h>", "<stdint.h>", "<string.h>", '"protocol.h"', '"frame.h"', '"output.h"', '"supervisor.h"'}
    assert set(includes) <= allowed | {'"limits.h"', '"pins.h"'}


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        (("#define P_MIN 800", "#define P_MIN 3500"), "limits out of order"),
        (("#define SLEW 20000U", "#define SLEW 10000U"), "SLEW is too slow to vent in time"),
        (("#define SENSOR_FULL 10000\n", "#define SENSOR_FULL 4000\n"), "cannot see an over-pressure"),
        (("#define SENSOR_FULL 10000\n", "#define SENSOR_FULL 200000\n"), "cannot see an over-pressure"),
        (("#define SENSOR_ZERO_MV 0", "#define SENSOR_ZERO_MV 4200"), "range of a sensor"),
        (("#define SENSOR_FULL_MV 5000", "#define SENSOR_FULL_MV 10000"), "range of a sensor"),
        (("#define REFERENCE_MV 1100", "#define REFERENCE_MV 11000"), "reference is 1.0 to 1.2 V"),
        (("#define LINK_TIMEOUT_MS 300", "#define LINK_TIMEOUT_MS 150"), "one late heartbeat"),
    ],
)
def test_impossible_limits_do_not_compile(tmp_path, changed, complaint):
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    text = (FIRMWARE / "limits.h").read_text()
    assert changed[0] in text
    (tmp_path / "limits.h").write_text(text.replace(*changed))
    (tmp_path / "limits.c").write_text('#include "limits.h"\n')
    done = subprocess.run(
        ["gcc", f"-I{FIRMWARE}", "-fsyntax-only", str(tmp_path / "limits.c")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert complaint in done.stderr


def test_channels_have_pins_of_arduino_core():
    """Port and bit of each pin in pins.h must be those of the Arduino core's table of the MEGA."""
    if not VARIANT.exists():
        pytest.skip("needs Debian package arduino-core-avr")
    rows = re.findall(r"X\((\d+), (\d+), (\d), ([ABC]), ([A-L]), (\d)\)", (FIRMWARE / "pins.h").read_text())
    assert [int(row[0]) for row in rows] == list(range(12))
    assert int(rows[-1][1]) == 13, "the pin of the bootloader's LED is not the last"
    ports = {
        int(pin): (port, int(bit))
        for port, bit, pin in re.findall(r"// P([A-L]) (\d) \*\* (\d+) \*\*", VARIANT.read_text())
    }
    timers = dict(re.findall(r"TIMER(\d[ABC])\s*,\s*// P[A-L] \d \*\* (\d+) \*\*", VARIANT.read_text()))
    timer_of = {int(pin): timer for timer, pin in timers.items()}
    assert timer_of[13] == "0A"  # the core uses timer 0 for pin 13; the chip connects timer 1, unit C, as well
    timer_of[13] = "1C"
    for _, pin, timer, unit, port, bit in rows:
        assert ports[int(pin)] == (port, int(bit)), f"pin {pin}"
        assert timer_of[int(pin)] == timer + unit, f"pin {pin}"

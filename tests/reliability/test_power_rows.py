"""Failure matrix, power and hardware of the board: rows 40 to 49, on the compiled firmware on the board's own clock.

Floating pins: the registers show whether a pin is an output; the filter with and without a pull-down is the rig's valve
model (`FilteredPins`). "Down": every command below 0.05 bar, permanently.
"""

import contextlib
import math
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from floating_pins import PULLED_DOWN_MS, add_rows, down_ms
from mega_in_run import Host, in_stepped_run, inject, stepped_host

from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.hil.board.stepped_port import SteppedPort
from modsoft.hil.board.toolchain import FIRMWARE, FIRMWARE_ELF, build, missing_packages
from modsoft.hil.outputs import read_outputs
from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.protocol import NOT_MEASURED, Fault, State
from modsoft.runtime.errors import DeviceAbsent, LostInRun, ProtocolMismatch, Tripped

missing = missing_packages("simavr")
pytestmark = [
    pytest.mark.skipif(bool(missing), reason=f"simavr needs {' '.join(missing)}"),
    pytest.mark.timeout(1800),
]

SENSORS_45 = "SENSOR_ZERO_MV=500 SENSOR_FULL_MV=4500 SENSORS=0x0fff"
ROBOT_45 = robot_file.parse(
    robot_file.text_of("pneumatic-3").replace("zero_v = 0.0", "zero_v = 0.5").replace("full_v = 5.0", "full_v = 4.5")
)


def test_row_40_floating_pins_on_opening_the_port(matrix_row, full):
    results = []
    for _ in range(20 if full else 2):
        with in_stepped_run() as (host, emulated):
            since = len(emulated.trace)
            host.port.close()
            emulated.run(1000, 0)
            with contextlib.closing(SteppedPort(emulated)) as port:
                port.idle(1.5)
                reset = next(filter(is_event("reset"), emulated.trace[since:]))
                results.append(down_ms(emulated, reset["t_us"]))
    add_rows(matrix_row, 40, "port opened in a run", results, "holds until setup(), 1 s", lambda ms: 800 < ms < 1000)


def test_row_41_floating_pins_after_a_watchdog_reset(matrix_row, full):
    results = []
    for number in range(20 if full else 2):
        with in_stepped_run() as (host, emulated):
            _, since = inject(emulated, ("hang", "hang cli")[number % 2], "hang")
            with pytest.raises(LostInRun):
                host.run_for(3.0)
            host.board.vent()
            reset = next(filter(is_event("reset"), emulated.trace[since:]))
            results.append(down_ms(emulated, reset["t_us"]))
    add_rows(matrix_row, 41, "watchdog reset", results, "holds until setup(), 6 s", lambda ms: 800 < ms < 6000)


def test_row_42_power_loss_of_the_board(matrix_row, full):
    results = []
    for _ in range(20 if full else 2):
        with in_stepped_run() as (host, emulated):
            off, _ = inject(emulated, "power-off")
            with pytest.raises(LostInRun):
                host.run_for(3.0)
            assert not host.board.vent(), "a vent was reported without power"
            results.append(down_ms(emulated, off["t_us"]))
            inject(emulated, "power-cycle")
            host.port.idle(1.5)
            assert not any(emulated.duties()), "power back: vented"
    add_rows(matrix_row, 42, "board without power", results, "holds until power returns", math.isinf)


def test_row_43_power_loss_of_the_pc(matrix_row, full):
    powered_by_usb, own_supply = [], []
    for _ in range(20 if full else 2):
        with in_stepped_run() as (_, emulated):
            off, _ = inject(emulated, "power-off")
            emulated.run(1_000_000, 0)
            powered_by_usb.append(down_ms(emulated, off["t_us"]))
        with in_stepped_run() as (_, emulated):
            off, _ = inject(emulated, "unplug")
            emulated.run(1_000_000, 0)
            own_supply.append(read_outputs(emulated.trace).vented_after_ms(off["t_us"]))
    matrix_row(
        43,
        fault="PC without power, supply of the board its own",
        tries=len(own_supply),
        limit="all 0 in 700 ms, with or without pull-downs",
        worst=f"{max(own_supply):.0f} ms",
        clock="emulated",
    )
    assert max(own_supply) <= 700
    add_rows(matrix_row, 43, "PC without power, board powered by USB", powered_by_usb, "holds", math.isinf)


# ---- Sensors and supply


@pytest.fixture(scope="module")
def sensors_45(tmp_path_factory):
    """The firmware for sensors of 0.5 to 4.5 V on all channels."""
    folder = tmp_path_factory.mktemp("sensors45")
    out = f"OUT={os.path.relpath(folder, FIRMWARE)}"
    subprocess.run(["make", "-s", "-C", FIRMWARE, out, *SENSORS_45.split()], check=True, stdout=subprocess.DEVNULL)
    return folder / FIRMWARE_ELF.name


@contextlib.contextmanager
def board_45(firmware):
    """(host, emulated board) with this firmware, all sensors without pressure, connected."""
    with EmulatedBoard("simavr", firmware=firmware, stepped=True) as emulated:
        for channel in range(12):
            emulated.send(f"adc {channel} 500")
        host = stepped_host(emulated)
        with contextlib.closing(host.port):
            yield host, emulated


def test_row_44_sensor_scale(matrix_row, sensors_45):
    with board_45(sensors_45) as (host, emulated):
        line = r"has 0.5 to 4.5 V for 0 to 1 bar, the robot file 0 to 5 V for 0 to 1 bar; correct SENSOR_ZERO_MV"
        with pytest.raises(ProtocolMismatch, match=line):
            host.board.arm(Host.ROBOT)
        assert host.board.status is None or host.board.status.state == State.IDLE
        for channel in range(12):
            emulated.send(f"adc {channel} {500 + 300 * channel}")
        host.port.idle(0.4)
        host.board._io_thread.wait(lambda: False, host.clock() + 0.3)
        measured = host.board.status.measured
        error = max(abs(units - 750 * channel) for channel, units in enumerate(measured))
        assert NOT_MEASURED not in measured
    matrix_row(
        44,
        fault="board for 0.5-4.5 V, robot file for 0-5 V",
        tries=1,
        limit="not armed, one line",
        worst="not armed, one line",
    )
    matrix_row(
        44,
        fault="0.5-4.5 V sensors on A0 to A11",
        tries=12,
        limit="within two steps of the converter, 2.5 mbar",
        worst=f"{error / 10:.1f} mbar",
    )
    assert error <= 25


def test_row_45_broken_sensor_wire(matrix_row, full, sensors_45, monkeypatch):
    monkeypatch.setattr(Host, "ROBOT", ROBOT_45)
    begun, vented = [], []
    for number in range(12 if full else 2):
        with board_45(sensors_45) as (host, emulated):
            host.board.arm(ROBOT_45)
            host.board.set_pressures(1, [0.08] * 6)
            host.due_s = math.inf
            host.run_for(0.2)
            assert host.board.applied_bar[0] == 0.08
            since = len(emulated.trace)
            emulated.send(f"adc {5 * number % 6} 0")
            broken_us = emulated.last_run["t_us"]
            with pytest.raises(Tripped, match="SENSOR"):
                host.run_for(2.0)
            host.port.idle(0.3)
            pwm = [event["t_us"] for event in emulated.trace[since:] if event["event"] == "pwm"]
            begun.append((pwm[0] - broken_us) / 1000)
            vented.append(read_outputs(emulated.trace).vented_after_ms(broken_us))
    matrix_row(
        45,
        fault="sensor wire broken (0.5-4.5 V)",
        tries=len(begun),
        limit="vent begins in 130 ms",
        worst=f"{max(begun):.0f} ms, all 0 in {max(vented):.0f} ms",
        clock="emulated",
    )
    assert max(begun) <= 130
    assert max(vented) <= 330


def test_row_46_low_supply(matrix_row, full):
    vented = []
    for _ in range(20 if full else 2):
        with in_stepped_run() as (host, emulated):
            sagged, _ = inject(emulated, "supply 4300")
            with pytest.raises(Tripped, match=r"SUPPLY \(supply now 4\.\d\d V, expected at least 4\.5 V\)"):
                host.run_for(2.0)
            host.port.idle(0.3)
            vented.append(read_outputs(emulated.trace).vented_after_ms(sagged["t_us"]))
            assert host.board.status.faults == Fault.SUPPLY
    matrix_row(
        46,
        fault="supply sags to 4.3 V",
        tries=len(vented),
        limit="all 0 in 400 ms",
        worst=f"{max(vented):.0f} ms",
        clock="emulated",
    )
    assert max(vented) <= 400


def test_row_47_arming_under_pressure(matrix_row, full):
    channels = range(6) if full else (0, 5)
    for channel in channels:
        with EmulatedBoard("simavr", stepped=True) as emulated:
            host = stepped_host(emulated)
            with contextlib.closing(host.port):
                emulated.send(f"adc {channel} {emulated.millivolt(0.06)}")
                with pytest.raises(Tripped, match=rf"channel {channel}: 0.0\d+ bar, expected less than 0.05; vent"):
                    host.board.arm(Host.ROBOT)
                assert host.board.status.state == State.IDLE
                emulated.send(f"adc {channel} 0")
                host.board.arm(Host.ROBOT)
    matrix_row(
        47,
        fault="chamber under pressure before arming",
        tries=len(channels),
        limit="not armed, one line; armed without pressure",
        worst="all",
    )


# ---- Checks and bootloader

CHECKS = [
    (name, line)
    for name in ("supervisor.c", "firmware.ino")
    for line in re.findall(r"^ +(?:uint8_t )?checks \|?= \w+\(.*;$", (FIRMWARE / name).read_text(), re.MULTILINE)
]


def resets_with(folder, name, old, new):
    """Causes of the resets in half a second of the board's time, with this change of a source file."""
    source = folder / "firmware" / name
    original = source.read_text()
    assert old in original
    source.write_text(original.replace(old, new))
    make = ("make", "-s", "-C", str(source.parent), "OUT=../built", "OURS=-w")
    subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
    source.write_text(original)
    elf = folder / "built" / FIRMWARE_ELF.name
    with EmulatedBoard("simavr", firmware=elf, bootloader=False, stepped=True) as board:
        board.run(500_000, 0)
        return [event["cause"] for event in board.trace if event["event"] == "reset"]


def test_row_48_skipped_check(matrix_row, tmp_path):
    build("simavr")
    shutil.copytree(FIRMWARE, tmp_path / "firmware")
    shutil.copytree(FIRMWARE_ELF.parent, tmp_path / "built")
    assert len(CHECKS) == 8
    assert resets_with(tmp_path, "supervisor.c", "checks", "checks") == ["power-on"]
    for name, line in CHECKS:
        assert "watchdog" in resets_with(tmp_path, name, line, re.sub("= .*;", "= 0;", line)), line
    assert "watchdog" in resets_with(tmp_path, "sensors.c", "_BV(ADEN) | ", ""), "converter off"
    matrix_row(
        48,
        fault="a check removed; the converter switched off",
        tries=len(CHECKS) + 1,
        limit="watchdog resets each",
        worst="each",
        clock="emulated",
    )


def test_row_49_bootloader_loops_after_a_watchdog_reset(matrix_row, tmp_path):
    elf, image = tmp_path / "boot.elf", tmp_path / "boot.hex"
    source = Path(__file__).parents[1] / "shared/looping_bootloader.S"
    flags = ["-mmcu=atmega2560", "-nostartfiles", "-Wl,--section-start=.text=0x3e000"]
    subprocess.run(["avr-gcc", *flags, "-o", elf, source], check=True)
    subprocess.run(["avr-objcopy", "-O", "ihex", elf, image], check=True)
    build("simavr")
    with EmulatedBoard("simavr", bootloader=image, stepped=True) as emulated:
        emulated.send("sensors 20")
        host = stepped_host(emulated)
        with contextlib.closing(host.port):
            host.start()
            _, since = inject(emulated, "hang", "hang")
            with pytest.raises(LostInRun, match="no STATUS from the board"):
                host.run_for(3.0)
            assert not host.board.vent()
            resets = [event for event in emulated.trace[since:] if event["event"] == "reset"]
            with_ms, without_ms = down_ms(emulated, resets[0]["t_us"])
        emulated.run(1000, 0)
        with pytest.raises(DeviceAbsent, match=r"remove its power .* docs/hardware.md"):
            stepped_host(emulated)
        inject(emulated, "power-cycle")
        emulated.run(1000, 0)
        again = stepped_host(emulated)
        again.port.close()
    assert len(resets) > 10
    assert {event["cause"] for event in resets} == {"watchdog"}
    matrix_row(
        49,
        fault="bootloader that leaves the watchdog on, pull-downs fitted",
        tries=1,
        limit=f"down in {PULLED_DOWN_MS:.0f} ms; host names the cause; back after power off",
        worst=f"{with_ms:.0f} ms, {len(resets)} resets, back after power off",
        clock="emulated",
    )
    matrix_row(
        49,
        fault="bootloader that leaves the watchdog on, no pull-downs",
        tries=1,
        limit="holds until power off",
        worst="pressure holds",
        clock="emulated",
    )
    assert with_ms <= PULLED_DOWN_MS
    assert math.isinf(without_ms)

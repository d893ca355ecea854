"""pwm.c, sensors.c and boot.c on a chip of plain memory. Register addresses are those of the ATmega2560's data sheet,
"Register Summary"."""

from __future__ import annotations

import ctypes
import re
import shutil
import zlib
from pathlib import Path

import pytest

from modsoft.runtime.board.protocol import CHANNELS, NOT_MEASURED, ResetCause

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
TIMERS = {1: 0x80, 3: 0x90, 4: 0xA0, 5: 0x120}  # TCCRnA; TCCRnB, TCNTn, ICRn and OCRnA to C follow
PORTS = {"B": 0x25, "E": 0x2E, "H": 0x102, "L": 0x10B}  # PORTx, DDRx before it
ADCL, ADCSRA, ADCSRB, ADMUX, DIDR0, DIDR2, MCUSR = 0x78, 0x7A, 0x7B, 0x7C, 0x7E, 0x7D, 0x54
MUX5 = 1 << 3  # in ADCSRB
CONVERTING, COMPLETE = 1 << 6, 1 << 4
TOP = 4095


class Sensors(ctypes.Structure):
    _fields_ = [
        ("measured", ctypes.c_int16 * CHANNELS),
        ("supply_mv", ctypes.c_uint16),
        ("input", ctypes.c_uint8),
        ("rounds", ctypes.c_uint8),
    ]


class Chip:
    """A chip after power-on."""

    def __init__(self, library: Path) -> None:
        self.code = ctypes.CDLL(str(library))
        self.code.boot_next_id.restype = ctypes.c_uint32
        self.code.boot_reset_cause.restype = ctypes.c_uint8
        self.code.sensors_poll.restype = ctypes.c_bool
        self.registers = (ctypes.c_uint8 * 0x200).in_dll(self.code, "chip")
        self.millis = ctypes.c_ulong.in_dll(self.code, "timer0_millis")
        self.watchdog_is_on = ctypes.c_int.in_dll(self.code, "watchdog_is_on")
        self.watchdog_resets = ctypes.c_int.in_dll(self.code, "watchdog_resets")

    def word(self, address: int) -> int:
        return self.registers[address] | self.registers[address + 1] << 8

    def boot(self, flags: int = 0) -> tuple[int, ResetCause]:
        self.registers[MCUSR] = flags
        self.code.boot_early()
        return self.code.boot_next_id(), ResetCause(self.code.boot_reset_cause())


def chip_of(library, folder):
    """A chip with its own copy of the library in `folder`, and so with its own memory."""
    if not library.exists():
        pytest.skip("needs Debian package avr-libc, for the names of the chip's registers")
    return Chip(shutil.copy(library, folder))


@pytest.fixture
def chip(native, tmp_path):
    return chip_of(native / "libchip.so", tmp_path)


# ---- PWM


@pytest.fixture
def outputs():
    """(timer, compare unit, port, bit) of each channel, from pins.h."""
    rows = re.findall(r"X\(\d+, \d+, (\d), ([ABC]), ([A-L]), (\d)\)", (FIRMWARE / "pins.h").read_text())
    return [(TIMERS[int(timer)], "ABC".index(unit), PORTS[port], int(bit)) for timer, unit, port, bit in rows]


def test_pins_are_low_before_they_become_outputs_and_no_timer_is_connected(chip, outputs):
    for port in PORTS.values():
        chip.registers[port] = 0xFF
    for timer in TIMERS.values():  # other settings before
        chip.registers[timer : timer + 14] = [0xA5] * 14
    chip.code.pwm_begin()
    for timer in TIMERS.values():
        assert chip.registers[timer] == 0b10  # no output connected; mode 14, fast PWM up to ICRn, in both registers
        assert chip.registers[timer + 1] == 0b11001  # no prescaler
        assert chip.word(timer + 6) == TOP
        assert chip.word(timer + 4) == 0  # all timers start together
    for channel, (_, _, port, bit) in enumerate(outputs):
        used = channel < 11
        assert chip.registers[port] >> bit & 1 == (not used)
        assert chip.registers[port - 1] >> bit & 1 == used
    assert sum(bin(chip.registers[port - 1]).count("1") for port in PORTS.values()) == 11  # no other pin


@pytest.mark.parametrize("channel", range(11))
def test_counts_reach_register_of_their_pin_and_no_other(chip, outputs, channel):
    chip.code.pwm_begin()
    timer, unit, _, _ = outputs[channel]
    before = bytes(chip.registers)
    for counts in (1, 478, 4096):
        chip.code.pwm_write(channel, counts)
        assert chip.word(timer + 8 + 2 * unit) == counts - 1
        assert chip.registers[timer] == 0b10 | 0b10 << (6 - 2 * unit)  # connected, not inverted
    chip.code.pwm_write(channel, 0)
    assert bytes(chip.registers) == before


def test_pin_of_bootloader_is_not_used(chip):
    chip.code.pwm_begin()
    before = bytes(chip.registers)
    for channel in (11, 12, 255):
        chip.code.pwm_write(channel, 100)
    assert bytes(chip.registers) == before


# ---- sensors


def convert(chip, sensors, reading):
    """End one conversion; return its input."""
    source = chip.registers[ADMUX]
    chip.registers[ADCL], chip.registers[ADCL + 1] = reading & 0xFF, reading >> 8
    chip.registers[ADCSRA] = chip.registers[ADCSRA] & ~CONVERTING | COMPLETE
    assert chip.code.sensors_poll(ctypes.byref(sensors))
    assert chip.registers[ADCSRA] & COMPLETE  # writing this 1 clears the flag
    chip.registers[ADCSRA] &= ~COMPLETE
    return source


def begin(chip):
    sensors = Sensors()
    ctypes.memset(ctypes.byref(sensors), 0xA5, ctypes.sizeof(sensors))
    chip.registers[ADCSRB] = 0xFF
    chip.code.sensors_begin(ctypes.byref(sensors))
    return sensors


REFERENCE = 0b01_0_11110  # the 1.1 V reference, against the supply


def test_no_channel_is_measured_before_its_first_reading(chip):
    sensors = begin(chip)
    assert list(sensors.measured) == [NOT_MEASURED] * 12
    assert sensors.supply_mv == 0
    assert (chip.registers[DIDR0], chip.registers[DIDR2]) == (0x3F, 0)
    assert chip.registers[ADCSRA] == 0b1_1_000_111  # on, started, 125 kHz
    assert chip.registers[ADCSRB] == 0  # inputs 0 to 7


@pytest.mark.parametrize("control", [0b1_1_000_111, 0b0_0_000_111], ids=["converting", "converter off"])
def test_poll_without_completed_conversion_changes_no_reading(chip, control):
    sensors = begin(chip)
    chip.registers[ADCSRA] = control
    before = bytes(sensors)
    assert not chip.code.sensors_poll(ctypes.byref(sensors))
    assert bytes(sensors) == before


def test_supply_first_then_8_rounds_of_all_sensors(chip):
    sensors = begin(chip)
    sources = [convert(chip, sensors, 225) for _ in range(2 * (2 + 8 * 6))]
    rounds = [0b01_0_00000 | channel for channel in range(6)]
    assert sources == ([REFERENCE] * 2 + rounds * 8) * 2
    assert chip.registers[ADCSRA] & CONVERTING


def test_supply_follows_from_settled_reference(chip):
    sensors = begin(chip)
    convert(chip, sensors, 1)
    assert sensors.supply_mv == 0  # the reference has not settled
    convert(chip, sensors, 225)
    assert sensors.supply_mv == 1100 * 1024 // 225
    for reading, supply_mv in ((18, 0), (19, 59284), (0, 0)):
        for _ in range(8 * 6 + 1):
            convert(chip, sensors, 225)
        convert(chip, sensors, reading)
        assert sensors.supply_mv == supply_mv


def test_readings_become_pressures(chip):
    sensors = begin(chip)
    for _ in range(2):
        convert(chip, sensors, 225)
    for reading in (0, 1, 32, 512, 1022, 1023):
        convert(chip, sensors, reading)
    assert list(sensors.measured) == [0, 10, 313, 5000, 9980, 9990] + [NOT_MEASURED] * 6  # 312.5: half is rounded up


@pytest.fixture
def sensor45(native, tmp_path):
    """Channels 0, 7, 8 and 11 with sensors of 0.5 V at 0 and 4.5 V at 2 bar."""
    return chip_of(native / "libsensor45.so", tmp_path)


@pytest.mark.parametrize(
    ("millivolt", "units"), [(500, 0), (4500, 20000), (2500, 10000), (250, -1250), (0, -2500), (5000, 22500)]
)
def test_pressure_of_sensor_with_offset(sensor45, millivolt, units):
    sensors = begin(sensor45)
    for _ in range(2):
        convert(sensor45, sensors, 225)
    reading = min(1023, round(millivolt * 1024 / 5000))
    convert(sensor45, sensors, reading)
    exact = (reading * 5000 / 1024 - 500) * 20000 / 4000
    assert abs(sensors.measured[0] - exact) <= 0.6  # rounded, and a slope of 12 fractional bits
    assert abs(sensors.measured[0] - units) <= 25  # half a step of the converter, a whole one at its end


def test_pressures_beyond_protocol_are_limited(native, tmp_path):
    """Readings of 32768.1 and -32768.1 units; -32768 is NOT_MEASURED."""
    chip = chip_of(native / "libsensor9bar.so", tmp_path)
    sensors = begin(chip)
    for _ in range(2):
        convert(chip, sensors, 225)
    for reading in (1023, 0, 200, 56, 199, 57):
        convert(chip, sensors, reading)
    exact = [(reading * 5000 / 1024 - 625) * 93207 / 1000 for reading in (199, 57)]
    assert list(sensors.measured)[:4] == [32767, -32767, 32767, -32767]
    assert list(sensors.measured)[4:6] == pytest.approx(exact, abs=0.6)


def test_inputs_8_to_11_are_selected_by_sixth_bit(sensor45):
    sensors = begin(sensor45)
    assert (sensor45.registers[DIDR0], sensor45.registers[DIDR2]) == (0x81, 0x09)
    for _ in range(2):
        assert sensor45.registers[ADCSRB] == 0
        convert(sensor45, sensors, 225)
    selected = []
    for _ in range(2 * (8 * 4 + 2)):
        high = sensor45.registers[ADCSRB]
        selected.append((high, convert(sensor45, sensors, 512)))
    rounds = [(0, 0b01_0_00000), (0, 0b01_0_00111), (MUX5, 0b01_0_00000), (MUX5, 0b01_0_00011)]
    assert selected == (rounds * 8 + [(0, REFERENCE)] * 2) * 2
    assert [channel for channel in range(12) if sensors.measured[channel] != NOT_MEASURED] == [0, 7, 8, 11]


def test_without_sensors_only_supply_is_measured(native, tmp_path):
    chip = chip_of(native / "libsensorless.so", tmp_path)
    sensors = begin(chip)
    assert {convert(chip, sensors, 225) for _ in range(500)} == {REFERENCE}
    assert sensors.supply_mv == 1100 * 1024 // 225
    assert list(sensors.measured) == [NOT_MEASURED] * 12
    assert chip.registers[DIDR0] == 0


# ---- reset


def test_boot_id_is_random_at_power_on_and_counts_resets(chip):
    first, cause = chip.boot()
    assert cause == ResetCause.POWER_ON
    assert first == zlib.crc32(bytes(36))  # all memory that a reset keeps
    assert [chip.boot() for _ in range(3)] == [(first + n, ResetCause.EXTERNAL) for n in (1, 2, 3)]


@pytest.mark.parametrize(
    ("flags", "cause"),
    [
        (0b1000, ResetCause.WATCHDOG),
        (0b0100, ResetCause.BROWN_OUT),
        (0b0001, ResetCause.POWER_ON),
        (0b0010, ResetCause.EXTERNAL),
        (0b1111, ResetCause.WATCHDOG),
        (0b0111, ResetCause.BROWN_OUT),
        (0b0011, ResetCause.POWER_ON),
    ],
)
def test_reset_flags_give_cause(chip, flags, cause):
    chip.boot()
    assert chip.boot(flags)[1] == cause
    assert chip.registers[MCUSR] == 0, "the flags would remain after the next reset"


@pytest.mark.parametrize(("hung_ms", "cause"), [(99, ResetCause.EXTERNAL), (100, ResetCause.WATCHDOG)])
def test_clock_shows_watchdog_reset_after_bootloader(chip, hung_ms, cause):
    chip.boot()
    chip.code.boot_feed_watchdog(5000, 5000)
    chip.millis.value = 5000 + hung_ms
    assert chip.boot()[1] == cause
    chip.millis.value = 0
    assert chip.boot()[1] == ResetCause.EXTERNAL, "the last feeding of the previous run counts"


@pytest.mark.parametrize(("supply_mv", "cause"), [(4499, ResetCause.BROWN_OUT), (4500, ResetCause.EXTERNAL)])
def test_low_supply_shows_brown_out_after_bootloader(chip, supply_mv, cause):
    chip.boot()
    chip.code.boot_feed_watchdog(5000, supply_mv)
    chip.millis.value = 5001
    assert chip.boot()[1] == cause
    chip.millis.value = 0
    assert chip.boot()[1] == ResetCause.EXTERNAL, "the supply of the previous run counts"


def test_watchdog_is_off_until_setup_and_fed_by_feeding(chip):
    chip.boot()
    assert chip.watchdog_is_on.value == 0
    chip.code.boot_feed_watchdog(1, 5000)
    assert chip.watchdog_resets.value == 1

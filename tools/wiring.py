"""Draws docs/wiring.svg from firmware/pins.h: from each output pin to its valve, from its sensor to the analogue input.

The parts between pin and valve are those that docs/hardware.md requires.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import click

ROOT = Path(__file__).parents[1]
PINS, PICTURE = ROOT / "firmware/pins.h", ROOT / "docs/wiring.svg"
BOOTLOADER_PIN = 13
ROW_PX, TOP_PX, WIDTH_PX = 46, 110, 1040
PIN_X, FILTER_X, AMPLIFIER_X, VALVE_X, SENSOR_X = 190, 330, 480, 640, 820


def channel_table(source: str) -> list[tuple[int, int]]:
    """(channel, Arduino pin) of every line of CHANNEL_TABLE in pins.h."""
    return [(int(channel), int(pin)) for channel, pin in re.findall(r"X\((\d+), (\d+),", source)]


def sensor_mask(source: str) -> int:
    """SENSORS of pins.h: bit c is set where channel c has a pressure sensor on A<c>."""
    definition = re.search(r"^#define SENSORS (0x[0-9a-fA-F]+)", source, re.MULTILINE)
    if definition is None:
        raise SystemExit("firmware/pins.h: no line '#define SENSORS 0x...'; the picture cannot be drawn")
    return int(definition[1], 16)


def _text(x: float, y: float, text: str, anchor: str = "middle", size: int = 13) -> str:
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}" font-size="{size}">{text}</text>'


def _wire(*points: tuple[float, float]) -> str:
    path = " ".join(f"{x},{y}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="black"/>'


def _box(x: float, y: float, width: float, *lines: str) -> list[str]:
    frame = f'<rect x="{x}" y="{y - 16}" width="{width}" height="32" fill="white" stroke="black"/>'
    first = y + 4 - 6.5 * (len(lines) - 1)
    return [frame, *(_text(x + width / 2, first + 13 * i, line, size=11) for i, line in enumerate(lines))]


def _ground(x: float, y: float) -> list[str]:
    return [_wire((x - 7 + 2 * i, y + 3 * i), (x + 7 - 2 * i, y + 3 * i)) for i in range(3)]


def _channel(channel: int, pin: int, has_sensor: bool, y: float) -> list[str]:
    drawn = [_text(PIN_X - 8, y + 4, f"D{pin}", "end"), _text(24, y + 4, f"channel {channel}", "start")]
    if pin == BOOTLOADER_PIN:
        return [
            *drawn,
            _text(PIN_X + 8, y + 4, "no valve while a bootloader is installed: it blinks this pin", "start", 12),
        ]
    drawn += [_wire((PIN_X, y), (VALVE_X, y)), _wire((PIN_X + 50, y), (PIN_X + 50, y + 4))]
    resistor = f'<rect x="{PIN_X + 46}" y="{y + 4}" width="8" height="14" fill="white" stroke="black"/>'
    drawn += [resistor, _wire((PIN_X + 50, y + 18), (PIN_X + 50, y + 21)), *_ground(PIN_X + 50, y + 21)]
    drawn += [_text(PIN_X + 60, y + 16, "10 k", "start", 11)]
    drawn += _box(FILTER_X, y, 110, "low-pass", "1 k, 10 uF")
    drawn += _box(AMPLIFIER_X, y, 110, "amplifier x 2", "0-5 V to 0-10 V")
    drawn += _box(VALVE_X, y, 110, "valve", "0-10 V command")
    if has_sensor:
        drawn += [_wire((VALVE_X + 110, y), (SENSOR_X, y)), *_box(SENSOR_X, y, 110, "divider", "at most 5 V")]
        drawn += [_wire((SENSOR_X + 110, y), (SENSOR_X + 140, y)), _text(SENSOR_X + 146, y + 4, f"A{channel}", "start")]
    return drawn


def picture(source: str) -> str:
    """The SVG document for the text of pins.h."""
    channels, mask = channel_table(source), sensor_mask(source)
    height = TOP_PX + ROW_PX * len(channels) + 20
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH_PX}" height="{height}" font-family="sans-serif">',
        f'<rect width="{WIDTH_PX}" height="{height}" fill="white"/>',
        _text(24, 30, "Arduino MEGA 2560: supply of its own (7 to 12 V on the barrel jack), USB for data", "start", 15),
        _text(24, 52, "GND of board, supply, filters, amplifiers, valves and sensors joined at one point", "start"),
        f'<rect x="12" y="{TOP_PX - 42}" width="{PIN_X - 12}" height="{height - 76}" fill="#eef4fb" stroke="black"/>',
    ]
    heads = {PIN_X + 50: "pull-down", FILTER_X + 55: "filter", AMPLIFIER_X + 55: "amplifier", VALVE_X + 55: "valve"}
    lines += [
        _text(x, TOP_PX - 26, head) for x, head in (heads | {SENSOR_X + 55: "pressure monitor", 100: "pins.h"}).items()
    ]
    for row, (channel, pin) in enumerate(channels):
        lines += _channel(channel, pin, bool(mask >> channel & 1), TOP_PX + ROW_PX * row + 8)
    return "\n".join([*lines, "</svg>"]) + "\n"


@click.command(help=__doc__)
@click.option("--check", is_flag=True, help="Write nothing; exit 1 when docs/wiring.svg is out of date.")
def main(check: bool) -> None:
    text = picture(PINS.read_text(encoding="ascii"))
    current = PICTURE.read_text(encoding="ascii") if PICTURE.exists() else None
    if current == text:
        return
    if check:
        click.echo("docs/wiring.svg is out of date: run python tools/wiring.py", err=True)
        sys.exit(1)
    PICTURE.write_text(text, encoding="ascii", newline="\n")


if __name__ == "__main__":
    main()

"""A bare host for the emulated board, run as a process of its own so that it can be killed.

`python drive_board.py PORT PRESSURE_BAR...`: opens the port, waits in silence for HELLO, sends heartbeats, arms, then
sends these pressures (one for each channel from 0 on, the others 0) ten times a second until it is killed. Standard
output, one JSON object a line: {"hello": ..., "after_s": ...} and then {"status": ...} for every STATUS.
Without pressures it only reads; with `--heartbeats N` it sends N frames as fast as the line takes them, once.

It uses only `modsoft.runtime.board.protocol`, so that the board is tested without the rest of the runtime.
"""

import json
import sys
import time

import serial

from modsoft.runtime.board.codec import Parser, encode
from modsoft.runtime.board.protocol import PROTOCOL_HASH, Arm, Heartbeat, Hello, Set, Status, to_units

BAUD = 250_000
PERIOD_S = 0.1


def main(port_name: str, *arguments: str) -> None:
    """Drive the board until killed."""
    port = serial.Serial(port_name, BAUD, timeout=0.01, exclusive=True)
    parser = Parser()
    opened = time.monotonic()
    burst = int(arguments[1]) if arguments[:1] == ("--heartbeats",) else 0
    pressures = [] if burst else [to_units(float(argument)) for argument in arguments]
    hello, armed, tick, next_beat = None, False, 0, 0.0
    while True:
        for frame in parser.feed(port.read(256)):
            if isinstance(frame.message, Hello):
                hello = frame.message
                armed, next_beat, tick = False, time.monotonic(), 0
                print(json.dumps({"hello": hello._asdict(), "after_s": time.monotonic() - opened}), flush=True)
            elif isinstance(frame.message, Status):
                armed |= frame.message.state >= 2
                print(json.dumps({"status": frame.message._asdict()}), flush=True)
        if hello is None:
            continue
        if burst:
            port.write(b"".join(encode(Heartbeat(n), 0, 0) for n in range(burst)))
            burst = 0
        if not pressures or time.monotonic() < next_beat:
            continue
        next_beat += PERIOD_S
        tick += 1
        port.write(encode(Heartbeat(tick), 0, 1))
        if armed:
            padded = pressures + [0] * (12 - len(pressures))
            port.write(encode(Set(tick, tuple(padded)), tick % 256, 1))
        elif tick > 12:
            channels = (1 << len(pressures)) - 1
            port.write(encode(Arm(PROTOCOL_HASH, hello.boot_id, 1, channels, hello.p_full), tick % 256, 1))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except serial.SerialException:
        pass  # the board was stopped first

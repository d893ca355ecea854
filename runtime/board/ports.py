"""Serial ports: which are there, which is the board's, finding it again by its USB identity, and opening it."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

from modsoft.runtime.errors import DeviceAbsent, PortBusy, UsageError

if TYPE_CHECKING:  # imported where a port is needed: a dry run needs none
    import serial

# Arduino MEGA 2560: Arduino's own identities, and the older and the Italian maker's numbers.
MEGA_IDENTITIES = {(0x2341, 0x0042), (0x2341, 0x0010), (0x2341, 0x0242), (0x2A03, 0x0042), (0x2A03, 0x0010)}
# Makers of what boards compatible with it have in the place of Arduino's USB chip: WCH, Silicon Labs, FTDI, Prolific.
COMPATIBLE_VENDORS = {vid for vid, _ in MEGA_IDENTITIES} | {0x1A86, 0x10C4, 0x0403, 0x067B}
BY_ID = Path("/dev/serial/by-id")
READ_WAIT_S = 0.005  # how long the I/O thread sleeps in a read; bounds how late it writes
# The board's own link time-out. pyserial also counts the time for which this process was held up by others, and a
# shorter wait took that for a port that takes nothing.
WRITE_WAIT_S = 0.3


class Port(Protocol):
    """What is used of a pyserial port. `read` waits a few milliseconds at most."""

    dtr: bool

    @property
    def in_waiting(self) -> int: ...
    def read(self, size: int = 1) -> bytes: ...
    def cancel_read(self) -> None: ...
    def write(self, data: bytes) -> int | None: ...
    def open(self) -> None: ...
    def close(self) -> None: ...


class PortInfo(NamedTuple):
    """One serial port. `name` is what to give as --port: under /dev/serial/by-id where that exists, because it stays
    the same when the board is plugged in elsewhere."""

    name: str
    device: str
    description: str
    vid: int | None
    pid: int | None
    serial_number: str | None

    @property
    def is_mega(self) -> bool:
        """Whether the USB identity is that of an Arduino MEGA 2560."""
        return (self.vid, self.pid) in MEGA_IDENTITIES

    def __str__(self) -> str:
        identity = f" {self.vid:04x}:{self.pid:04x}" if self.vid is not None and self.pid is not None else ""
        serial_number = f", serial number {self.serial_number}" if self.serial_number else ""
        mega = " (Arduino MEGA 2560)" if self.is_mega else ""
        return f"{self.name}{identity} {self.description}{serial_number}{mega}"


def list_ports() -> list[PortInfo]:
    """The serial ports of this machine, MEGAs first."""
    from serial.tools import list_ports as serial_list_ports

    stable = {}
    if BY_ID.is_dir():
        stable = {str(link.resolve()): str(link) for link in sorted(BY_ID.iterdir())}
    ports = [
        PortInfo(
            stable.get(str(Path(port.device).resolve()), port.device),
            port.device,
            port.description or "",
            port.vid,
            port.pid,
            port.serial_number,
        )
        for port in serial_list_ports.comports()
    ]
    return sorted(ports, key=lambda port: (not port.is_mega, port.vid is None, port.name))


def ports_here() -> str:
    """The ports of this machine as half a sentence for an error message; those with a USB identity if there are any."""
    ports = list_ports()
    usb = [port for port in ports if port.vid is not None]
    names = [str(port) for port in usb or ports]
    return f"ports here: {'; '.join(names)}" if names else "there is no serial port on this machine: is it plugged in?"


def find_port(told: str) -> str:
    """The port to open for what a user told: the name of a port, or the USB serial number of the board, which finds it
    under whatever name it has after it was plugged in again. Nothing is opened.

    Raises `DeviceAbsent` when there is neither (names the MEGA that is there under another name), `UsageError` when
    two boards have the same number.
    """
    if os.path.exists(told):
        return told
    found = list_ports()
    fitting = [port.device for port in found if told in (port.serial_number, port.name, port.device)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise UsageError(f"{told} is the serial number of {len(fitting)} devices; give one of {', '.join(fitting)}")
    if os.name != "posix":
        return told  # not every name that Windows takes is in its list
    megas = [port for port in found if port.is_mega]
    if len(megas) == 1 and megas[0].serial_number:
        number = megas[0].serial_number
        raise DeviceAbsent(
            f"no board at {told}: no such port; there is an Arduino MEGA at {megas[0].name}, which "
            f"--port {number} (its serial number) finds under any name"
        )
    raise DeviceAbsent(f"no board at {told}: no such port; {ports_here()}")


def may_be_mega(name: str) -> bool:
    """Whether a MEGA, or a board compatible with it, may be at this port; False only where the operating system knows
    of a device of another maker there, or of a port without USB."""
    device = os.path.realpath(name)
    vendors = [port.vid for port in list_ports() if os.path.realpath(port.device) == device]
    return not vendors or vendors[0] in COMPATIBLE_VENDORS


def open_port(name: str, baud: int) -> serial.Serial:
    """Open a port for this program alone. Raises `DeviceAbsent` (not there), `PortBusy` (in use or not permitted)."""
    import serial

    try:
        port = serial.Serial(name, baud, timeout=READ_WAIT_S, write_timeout=WRITE_WAIT_S, exclusive=True)
    except (OSError, ValueError) as error:
        raise _explained(name, error) from error
    # What lies in the buffer was sent before the board's reset by this very opening.
    port.reset_input_buffer()
    return port


def _explained(name: str, error: Exception) -> DeviceAbsent | PortBusy:
    number = getattr(error, "errno", None)
    text = str(error)
    if number in (errno.EACCES, errno.EPERM):
        return PortBusy(
            f"{name} may not be opened by this user: join the group that owns it (sudo adduser $USER dialout)"
        )
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "PermissionError" in text:
        return PortBusy(
            f"{name} is in use by another program: close it (a serial monitor, another run) and start again"
        )
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTDIR) or "FileNotFoundError" in text:
        return DeviceAbsent(f"no board at {name}: no such port; {ports_here()}")
    return DeviceAbsent(f"no board at {name}: it is no serial port ({text}); {ports_here()}")

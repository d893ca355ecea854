"""Serial ports: list, find by name or serial number, open."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

from modsoft.runtime.errors import DeviceAbsent, PortBusy, UsageError

if TYPE_CHECKING:  # imported on use: a dry run needs no pyserial
    import serial

# Arduino MEGA 2560: vendor and product ids, including older ones.
MEGA_IDENTITIES = {(0x2341, 0x0042), (0x2341, 0x0010), (0x2341, 0x0242), (0x2A03, 0x0042), (0x2A03, 0x0010)}
# Vendors of the USB chips of compatible boards: WCH, Silicon Labs, FTDI, Prolific.
COMPATIBLE_VENDORS = {vid for vid, _ in MEGA_IDENTITIES} | {0x1A86, 0x10C4, 0x0403, 0x067B}
BY_ID = Path("/dev/serial/by-id")
READ_WAIT_S = 0.005  # time-out of a read in the I/O thread, which delays a write
# Equals the link time-out of the board. pyserial counts the time in which this process does not run, so that a shorter
# time-out reports a working port as blocked.
WRITE_WAIT_S = 0.3


class Port(Protocol):
    """The part of the pyserial interface in use. `read` waits a few milliseconds at most."""

    dtr: bool

    @property
    def in_waiting(self) -> int: ...
    def read(self, size: int = 1) -> bytes: ...
    def cancel_read(self) -> None: ...
    def write(self, data: bytes) -> int | None: ...
    def open(self) -> None: ...
    def close(self) -> None: ...


class PortInfo(NamedTuple):
    """A serial port. `name` is the value for --port: a path below /dev/serial/by-id where one exists, which does not
    change when the board is connected elsewhere."""

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
    """Lists the serial ports of this machine, MEGAs first."""
    from serial.tools import list_ports as serial_list_ports

    stable = {}
    if BY_ID.is_dir():
        stable = {str(path.resolve()): str(path) for path in sorted(BY_ID.iterdir())}
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


def describe_ports() -> str:
    """Describes the ports of this machine for an error message: those with a USB identity, or all if none has one."""
    ports = list_ports()
    usb = [port for port in ports if port.vid is not None]
    names = [str(port) for port in usb or ports]
    return f"ports here: {'; '.join(names)}" if names else "no serial port on this machine: is it plugged in?"


def find_port(name: str) -> str:
    """Returns the port for `name`: a port, or the USB serial number of a board. Opens nothing.

    Raises `DeviceAbsent` if there is neither (naming a MEGA at another port), `UsageError` if two boards have the same
    number.
    """
    if os.path.exists(name):
        return name
    ports = list_ports()
    matching = [port.device for port in ports if name in (port.serial_number, port.name, port.device)]
    if len(matching) == 1:
        return matching[0]
    if matching:
        raise UsageError(f"{name} is the serial number of {len(matching)} devices; give one of {', '.join(matching)}")
    if os.name != "posix":
        return name  # Windows accepts names that it does not list
    megas = [port for port in ports if port.is_mega]
    if len(megas) == 1 and megas[0].serial_number:
        number = megas[0].serial_number
        raise DeviceAbsent(
            f"no board at {name}: no such port; found an Arduino MEGA at {megas[0].name}; give its "
            f"serial number, --port {number}, which does not depend on the port"
        )
    raise DeviceAbsent(f"no board at {name}: no such port; {describe_ports()}")


def may_be_mega(name: str) -> bool:
    """Whether a MEGA or a compatible board may be at this port; False only if the operating system reports another
    vendor, or a port without USB."""
    device = os.path.realpath(name)
    vendors = [port.vid for port in list_ports() if os.path.realpath(port.device) == device]
    return not vendors or vendors[0] in COMPATIBLE_VENDORS


def open_port(name: str, baud: int) -> serial.Serial:
    """Opens a port exclusively. Raises `DeviceAbsent` (no such port), `PortBusy` (in use or not permitted)."""
    import serial

    try:
        port = serial.Serial(name, baud, timeout=READ_WAIT_S, write_timeout=WRITE_WAIT_S, exclusive=True)
    except (OSError, ValueError) as error:
        raise _open_error(name, error) from error
    # Bytes in the buffer were sent before opening the port reset the board.
    port.reset_input_buffer()
    return port


def _open_error(name: str, error: Exception) -> DeviceAbsent | PortBusy:
    number = getattr(error, "errno", None)
    text = str(error)
    if number in (errno.EACCES, errno.EPERM):
        return PortBusy(
            f"{name}: this user has no permission: join the group that owns it (sudo adduser $USER dialout)"
        )
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "PermissionError" in text:
        return PortBusy(
            f"{name} is in use by another program: close it (a serial monitor, another run) and start again"
        )
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTDIR) or "FileNotFoundError" in text:
        return DeviceAbsent(f"no board at {name}: no such port; {describe_ports()}")
    return DeviceAbsent(f"no board at {name}: not a serial port ({text}); {describe_ports()}")

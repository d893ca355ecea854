"""A fake tracker of passive tools on a pseudo-terminal, in a process of its own.

`python -m modsoft.hil.polaris --link PATH` makes PATH a serial port with the device's ASCII protocol (and its
binary `BX` answer) well enough for the unmodified scikit-surgerynditracker. With `--type vega` it is on a network
port of this machine instead of PATH; with `--type aurora` and `--wired N` it has N wired tools. It is a process because
that client holds the interpreter lock while it looks for a device. Standard input has one JSON object a line with any
of these keys, and its end ends the process:

    {"poses": [[4 x 4], ...]}  poses of the tools, base first, mm, in the tracker's frame; the newest are reported
    {"hide": [k, ...]}         tools that are missing from now on (0 is the base); [] shows all again
    {"lose": [k, ...]}         tools that are not in the reply
    {"freeze": true}           the same frame and number again
    {"delay_s": s}             frames and their numbers are this old
    {"back": n}                frame numbers n smaller
    {"jump": {"tool": k, "mm": [x, y, z], "deg": d}}   tool k is moved and turned about its own y axis; null ends it
    {"swap": [j, k]}           two tools are swapped; null ends it
    {"corrupt": true}          a wrong checksum in every reply to TX and BX
    {"damage": {"seed": n, "rate": r, "kinds": [...]}}   bytes of replies flipped, dropped, inserted, delayed while it
                               tracks (`modsoft.hil.byte_damage`); null ends it
    {"rms_mm": {"k": e}}       tool k is measured with this RMS error; {} ends it
    {"port_status": {"k": n}}  tool k has this port status; {} ends it
    {"five_dof": [k, ...]}     tools whose roll is not measured
    {"mute": true}             no reply
    {"unplug": true}           the port goes away; false brings it back

Standard output, one JSON line each: {"event": "ready", "port": PATH or ADDRESS}, {"event": "tracking", "mono_ns"} at
every TSTART, {"event": "summary", "commands": {name: count}, "frames"} at the end.

Replies take the time of a line of 115200 baud, unless `--unpaced`.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import sys
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from modsoft.hil.polaris_device import FRAME_HZ, Polaris
from modsoft.hil.tool_errors import NO_ERRORS, ToolErrors
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import UsageError

SECONDS_A_BYTE = 10 / 115200


class Pty:
    """A pseudo-terminal under a name of its own. Its other end is kept open here, so that a client may come and go."""

    def __init__(self, link: Path, seconds_a_byte: float = SECONDS_A_BYTE):
        self.link, self._seconds_a_byte = link, seconds_a_byte
        self.plug()

    @property
    def address(self) -> str:
        return str(self.link)

    def plug(self) -> None:
        if self.link.exists() and not self.link.is_symlink():
            raise UsageError(f"{self.link}: exists and is no link; give another --link")
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        new_link = self.link.with_name(self.link.name + ".new")
        new_link.unlink(missing_ok=True)
        new_link.symlink_to(os.ttyname(self._slave))
        new_link.replace(self.link)
        self._pending = b""

    def unplug(self) -> None:
        self.link.unlink(missing_ok=True)
        if self.master >= 0:
            os.close(self.master)
            os.close(self._slave)
            self.master = -1

    def commands(self) -> list[bytes]:
        """Whole commands that have come in."""
        *whole, self._pending = (self._pending + os.read(self.master, 4096)).split(b"\r")
        return whole

    def write(self, reply: bytes) -> None:
        """Sends a reply in the time of the line."""
        if self._seconds_a_byte:
            time.sleep(len(reply) * self._seconds_a_byte)
        try:
            os.write(self.master, reply)
        except BlockingIOError:
            pass  # no process reads, as on a real line


class Network:
    """A port of the network, for this machine alone: the `Pty` of a device of type vega. One client at a time."""

    def __init__(self) -> None:
        self.port = 0
        self._client: Any = None
        self._pending = b""
        self.plug()

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    def plug(self) -> None:
        self._server = socket.create_server(("127.0.0.1", self.port))
        self.port = self._server.getsockname()[1]
        self._await_client()

    def unplug(self) -> None:
        if self._client is not None:
            self._client.close()
        self._server.close()
        self.master = -1

    def commands(self) -> list[bytes]:
        """Whole commands that have come in; the client may have come or gone instead."""
        if self._client is None:
            self._client, _ = self._server.accept()
            self.master = self._client.fileno()
            return []
        try:
            data = self._client.recv(4096)
        except ConnectionError:
            data = b""
        if not data:
            self._client.close()
            self._await_client()
            return []
        *whole, self._pending = (self._pending + data).split(b"\r")
        return whole

    def write(self, reply: bytes) -> None:
        if self._client is not None:
            with contextlib.suppress(ConnectionError):
                self._client.sendall(reply)

    def _await_client(self) -> None:
        self._client = None
        self._pending = b""
        self.master = self._server.fileno()


def serve(device: Polaris, line: Pty | Network, say: Callable[[dict[str, Any]], None], stdin: int) -> None:
    """Until the standard input ends."""
    pending = b""
    while True:
        ready = select.select([stdin, *([line.master] if line.master >= 0 else [])], [], [])[0]
        if stdin in ready:
            chunk = os.read(stdin, 65536)
            if not chunk:
                return
            *lines, pending = (pending + chunk).split(b"\n")
            for text in filter(None, lines):
                device.take(json.loads(text))
            if device.faults.get("unplug") and line.master >= 0:
                line.unplug()
            elif not device.faults.get("unplug") and line.master < 0:
                line.plug()
        if line.master >= 0 and line.master in ready:
            for command in line.commands():
                tracked = device.tracking
                for pause_s, part in device.sent(device.answer(command)):
                    if pause_s:
                        time.sleep(pause_s)
                    line.write(part)
                if device.tracking and not tracked:
                    say({"event": "tracking", "mono_ns": time.monotonic_ns()})


def write_tool_files(folder: Path, tools: int) -> list[Path]:
    """Tool definition files for this many tools, base first. The fake takes any content; the client sends them as they
    are, and a real device would refuse these."""
    paths = [folder / ("base.rom" if tool == 0 else f"module-{tool}.rom") for tool in range(tools)]
    for path in paths:
        path.write_bytes(b"NDI\0" + path.stem.encode().ljust(748, b"\0"))
    return paths


@click.command("modsoft-hil-polaris")
@click.option("--link", required=True, type=click.Path(path_type=Path), help="Name that the serial port gets.")
@click.option(
    "--firmware",
    default="Polaris Spectra Rev 009",
    show_default=True,
    help='Its version; one that ends in "Rev 007" makes the client ask for TX in place of BX.',
)
@click.option(
    "--type",
    "kind",
    default="polaris",
    show_default=True,
    type=click.Choice(list(FRAME_HZ)),
    help="As in the robot file.",
)
@click.option("--wired", default=0, help="Tools that are wired to it: aurora.")
@click.option("--frame-hz", type=float, help="Frame rate.  [default: 60; aurora: 40]")
@click.option("--unpaced", is_flag=True, help="Answer at once, not in the time of a serial line.")
@click.option(
    "--errors",
    default=tuple(NO_ERRORS),
    type=(float, float, float, float, int),
    metavar="DEG MM DEG MM SEED",
    help="Largest mounting errors of the tools, standard deviations of their noise, and a seed.",
)
def cli(
    link: Path,
    firmware: str,
    kind: str,
    wired: int,
    frame_hz: float | None,
    unpaced: bool,
    errors: tuple[float, float, float, float, int],
) -> None:
    """A fake optical tracker (started by modsoft-hil)."""

    def say(event: dict[str, Any]) -> None:
        sys.stdout.write(json.dumps(event) + "\n")
        sys.stdout.flush()

    device = Polaris(firmware=firmware, kind=kind, wired=wired, frame_hz=frame_hz, errors=ToolErrors(*errors))
    line = Network() if kind == "vega" else Pty(link, 0.0 if unpaced else SECONDS_A_BYTE)
    try:
        say({"event": "ready", "port": line.address})
        serve(device, line, say, sys.stdin.fileno())
    finally:
        line.unplug()
    say({"event": "summary", "commands": dict(device.commands), "frames": device.frames})


main = entry(cli)

if __name__ == "__main__":
    main()
